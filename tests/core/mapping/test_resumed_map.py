"""A map that is gone on with takes no more memory and no less time than the run that it was saved in."""

from __future__ import annotations

import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints import checkpoint, state
from mvsgs_core.mapping.checkpoints.begun import begin_on
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.resting_images import bytes_of
from mvsgs_core.stats import Stats
from tests.support.full_disk import full_after
from tests.support.small_atlas import PLAIN, between, view, written

FEW = replace(PLAIN, iterations=2, images_in_memory=3, window=2)


def mapped(config: MapperConfig, halvings: int = 0) -> Atlas:
    """Six keyframes and two frames between them, which the stream has left for a part of three keyframes."""
    atlas = Atlas(OnlineMapper(config))
    for index in range(3, 5):
        atlas.add_between(replace(between(index, index - 1), index=20 + index))
    for index in range(6):
        atlas.add(view(index), 0, halvings)
    for index in (6, 7, 8):
        atlas.add(view(index), 1, halvings)
    return atlas


def resting(atlas: Atlas) -> dict[int, bool]:
    return {known.index: known.image_on_disk for part in atlas.parts.values() for known in part.keyframes.trained}


def test_images_that_rested_on_disk_go_there_as_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas = mapped(FEW)
    expected = resting(atlas)
    assert sum(not rests for rests in expected.values()) == 2 + 3
    written(atlas, tmp_path)
    read, reader = [], checkpoint.read_image
    most = 0

    def counted(*given: Any) -> tuple[torch.Tensor, torch.Tensor | None]:
        nonlocal most
        found = reader(*given)
        read.append(weakref.ref(found[0]))
        most = max(most, sum(image() is not None for image in read))
        return found

    monkeypatch.setattr(checkpoint, "read_image", counted)
    again, _ = checkpoint.load(tmp_path, FEW, Stats())
    assert resting(again) == expected
    assert len(read) == len(expected) == 11
    assert most <= 2 + 3 + 1, "those that stay, and the one that is being read"
    for part, other in zip(atlas.parts.values(), again.parts.values()):
        for one, two in zip(part.keyframes.trained, other.keyframes.trained):
            assert torch.equal(one.image, two.image)
            assert (one.valid is None) == (two.valid is None)
            assert one.valid is None or two.valid is None or torch.equal(one.valid, two.valid)
    begun = begin_on(tmp_path, FEW, Stats())
    assert list(resting(begun).values()) == list(expected.values())


def test_of_a_gpu_s_memory_they_take_no_more_than_their_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(FEW, images_in_memory=1000)
    folder = written(mapped(config), tmp_path)
    plain, _ = checkpoint.load(folder, config, Stats())
    newest = plain.current.keyframes.trained[-3:]
    monkeypatch.setattr(state, "room_of", lambda device: bytes_of(newest[1]) + bytes_of(newest[2]) + 1)
    again, _ = checkpoint.load(folder, config, Stats())
    assert [view.image_on_disk for view in again.current.keyframes.trained] == [True, False, False]
    assert all(torch.equal(a.image, b.image) for a, b in zip(newest, again.current.keyframes.trained))


def test_where_the_disk_is_full_the_map_is_gone_on_with_in_memory(tmp_path: Path) -> None:
    written(mapped(FEW), tmp_path)
    log = Stats()
    with full_after(0):
        again, _ = checkpoint.load(tmp_path, FEW, log)
    assert not any(resting(again).values())
    assert any("images stay in memory" in text for text in log.warnings)


def test_as_many_iterations_are_made_up_as_without_a_pause(tmp_path: Path) -> None:
    """After the stream: keyframes that got their splats late bring some of their own."""
    atlas = mapped(replace(FEW, realtime=True, iterations=30, refinement=60), halvings=1)
    atlas.finish()
    while len(atlas.current.coarse):
        assert atlas.make_up()
    again, _ = checkpoint.load(written(atlas, tmp_path), atlas.current.config, Stats())
    made = [0, 0]
    for k, one in enumerate((atlas, again)):
        while one.make_up():
            made[k] += 1
    assert made[0] == made[1] > 60
