"""A map that another run left: the same map, of keyframes numbered below the new stream's, to which it adds its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.export.keyframe_images import write_image
from mvsgs_core.kept_map import STREAM
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.checkpoints.results import NOT_THERE, write_results
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.stats import Stats
from tests.support.patience import LONG
from tests.support.small_atlas import PLAIN, begun, view


def kept(tmp_path: Path, config: MapperConfig = PLAIN) -> Atlas:
    """The atlas that was written to the folder."""
    atlas = begun(config)
    writer = CheckpointWriter(tmp_path, atlas.current.config)
    writer.submit(atlas.frozen(), sync=False)
    assert writer.wait(LONG)
    return atlas


def test_it_is_the_same_map_of_keyframes_before_the_stream(tmp_path: Path) -> None:
    was, log = kept(tmp_path), Stats()
    now = begin_on(tmp_path, PLAIN, log)
    assert now.parts.keys() == was.parts.keys()
    assert now.newest_view == -1
    assert now.revision == -1
    assert not log.counts, "what the other run counted is not this one's"
    for segment, part in now.parts.items():
        before = was.parts[segment]
        assert [v.index + STREAM for v in part.views] == [v.index for v in before.views]
        assert torch.equal(part.state.anchors + STREAM, before.state.anchors)
        assert torch.equal(part.state.splats.means, before.state.splats.means)
        assert all(v.scale == 1.0 for v in part.views)
        assert part.schedule.pending == 0
        for a, b in zip(part.views, before.views):
            assert torch.equal(part.render(a).color, before.render(b).color)
        for a, b in zip(part.keyframes.between, before.keyframes.between):
            assert a.keyframe + STREAM == b.keyframe
            a.follow(part.keyframes.of(a.keyframe), part.frame)  # type: ignore[arg-type]
            b.follow(before.keyframes.of(b.keyframe), before.frame)  # type: ignore[arg-type]
            assert np.allclose(a.local_from_cam, b.local_from_cam)
    assert {k + STREAM for k in now.current.photometry.exposures} == set(was.current.photometry.exposures)


def test_the_stream_extends_corrects_and_joins_it(tmp_path: Path) -> None:
    kept(tmp_path)
    atlas = begin_on(tmp_path, PLAIN, Stats())
    before = len(atlas.parts[0].views)
    assert atlas.add(replace(view(0), timestamp=0.0), 0) is not None
    assert atlas.current is atlas.parts[0]
    assert [v.index for v in atlas.current.views][before - 1 :] == [5 - STREAM, 0]
    old = atlas.parts[0].views[1]
    where, splats = old.world_from_cam.copy(), atlas.parts[0].state.splats.means.detach().clone()
    moved = where.copy()
    moved[:3, 3] += 0.1
    atlas.correct(np.array([old.index]), moved[None], np.array([1.0]))
    own = atlas.parts[0].state.anchors == old.index
    assert own.any()
    shift = (atlas.parts[0].state.splats.means.detach() - splats) * atlas.parts[0].frame.length
    assert torch.allclose(shift[own], torch.full((1, 3), 0.1), atol=1e-5)
    assert not shift[~own].any()
    assert atlas.add(view(1), 7) is not None  # a part of its own, until it is found where it belongs
    assert atlas.current is atlas.parts[7]
    index = np.array([1])
    atlas.correct(index, view(1).world_from_cam[None], np.ones(1), np.array([0], np.int32))
    assert 7 not in atlas.parts
    assert atlas.current.views[-1].index == 1


def test_of_parts_that_stay_apart_the_stream_is_shown_where_it_was(tmp_path: Path) -> None:
    kept(tmp_path)
    atlas, log = begin_on(tmp_path, PLAIN, log := Stats()), log
    atlas.add(view(0), 7)
    atlas.finish()
    assert atlas.current is atlas.parts[7]
    assert any("was not found in the map" in warning for warning in log.warnings)
    assert len(atlas.parts[0].views) > 1, "the other part stays in what is kept"


def test_its_images_are_not_named_where_only_the_new_streams_are_kept(tmp_path: Path) -> None:
    kept(tmp_path / "before")
    atlas, log = begin_on(tmp_path / "before", PLAIN, log := Stats()), log
    atlas.add(view(0), 0)
    write_image(tmp_path / "keyframes", 0, view(0).image)
    write_results(tmp_path, atlas.current)
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["keyframes/000000.png"]
    assert log.skipped[NOT_THERE] == len(atlas.current.views) - 1


def test_nothing_to_begin_on_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no checkpoint"):
        begin_on(tmp_path, PLAIN, Stats())
    kept(tmp_path)
    with pytest.raises(ValueError, match="sh_degree"):
        begin_on(tmp_path, replace(PLAIN, sh_degree=1), Stats())
