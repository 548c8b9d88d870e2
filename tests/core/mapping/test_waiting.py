"""Keyframes that wait for their splats go with a copy of their map, and with its checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.array_file import Arrays
from mvsgs_core.kept_map import STREAM
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.checkpoints.checkpoint import load
from mvsgs_core.mapping.checkpoints.waiting import waiting_arrays, waiting_of
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.coarse import Kept
from mvsgs_core.mapping.mapper import NONE_NOW, OnlineMapper
from mvsgs_core.stats import Stats
from tests.support.small_atlas import PLAIN, view

LIVE = replace(PLAIN, realtime=True)


def waiting_atlas() -> Atlas:
    """Three keyframes, two without any splats, one of them of a rolling shutter; one has another scale now."""
    atlas = Atlas(OnlineMapper(LIVE))
    photograph = np.full_like(view(2).image, 255)
    shutter = replace(view(2), photograph=photograph, velocity=np.full(6, 0.01), readout_time=0.02)
    for given in (view(0), view(1), shutter):
        atlas.add(replace(given, unfiltered=given.depth, confidence=np.ones_like(given.depth)), 0, NONE_NOW)
    atlas.correct(np.array([1]), view(1).world_from_cam[None], np.array([1.1]))
    return atlas


def told(kept: Kept) -> tuple[object, ...]:
    k = kept.keyframe
    arrays = (k.depth, k.unfiltered, k.confidence, k.normals, kept.image)
    shown = [None if a is None else (a.dtype, a.shape, a.tobytes()) for a in arrays]
    return k.index, k.scale, kept.unit, kept.none, shown


def completed(atlas: Atlas) -> np.ndarray:
    """The splats of all keyframes by their keyframe, once none waits."""
    while len(atlas.current.coarse):
        assert atlas.make_up()
    return atlas.current.state.anchors.numpy()


def test_a_copy_and_a_checkpoint_wait_as_the_map_does(tmp_path: Path) -> None:
    atlas = waiting_atlas()
    expected = [told(kept) for kept in atlas.current.coarse.kept]
    assert [kept[0] for kept in expected] == [0, 1, 2]
    frozen = atlas.frozen()
    CheckpointWriter(tmp_path, LIVE).write(frozen)
    loaded, _ = load(tmp_path, LIVE, Stats())
    for other in (frozen, loaded):
        assert [told(kept) for kept in other.current.coarse.kept] == expected
    anchors = completed(atlas)
    assert set(anchors.tolist()) == {0, 1, 2}
    for other in (frozen, loaded):
        np.testing.assert_array_equal(completed(other), anchors)


def test_a_map_that_is_gone_on_with_gets_them_where_it_is_now(tmp_path: Path) -> None:
    atlas = waiting_atlas()
    CheckpointWriter(tmp_path, LIVE).write(atlas.frozen())
    np.testing.assert_array_equal(completed(begin_on(tmp_path, LIVE, Stats())) + STREAM, completed(atlas))


def test_damage_is_refused() -> None:
    mapper = waiting_atlas().current
    arrays = waiting_arrays(mapper.coarse.kept)
    assert len(waiting_of(Arrays(arrays), mapper.views)) == 3
    endless = arrays["waiting/1/depth"].copy()
    endless[0, 0] = np.inf
    for name, value in {
        "waiting": np.array([0, 1, 1]), "waiting/scale": np.array([1.0, 0.0, 1.0]), "waiting/unit": np.ones(2),
        "waiting/0/depth": np.zeros((0, 4), np.float16), "waiting/1/depth": endless,
        "waiting/1/confidence": np.zeros((2, 2), np.float16), "waiting/2/image": np.zeros((2, 2, 3), np.uint8),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match="wait"):
            waiting_of(Arrays({**arrays, name: value}), mapper.views)
    with pytest.raises(ValueError, match="are not there"):
        waiting_of(Arrays(arrays), mapper.views[:2])
