"""The images that a program saves with its map: those that a run writes with mapper.save_images=true."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from launch.compose import compose
from launch.inline import run_inline
from msgs import Frame, GroundTruth
from mvsgs import Mapping
from mvsgs_core.datasets import Item
from mvsgs_core.kept_map import STREAM, check_kept_map
from nodes import Node
from tests.support.sequences import synthetic

pytestmark = pytest.mark.slow

SMALL = ["mapper.iterations=1", "mapper.refinement=0", "device=cpu", "mapper.threads=1"]


def room() -> tuple[Item, ...]:
    return synthetic(frames=16, size=(96, 128))


class Posed(Node):
    def run(self) -> Iterator[Frame | GroundTruth]:
        for item in room():
            yield Frame(item.index, item.timestamp, item.image, item.intrinsics)
            yield GroundTruth(item.index, item.timestamp, item.image, item.intrinsics, item.world_from_cam, item.depth)


@pytest.mark.parametrize("more", ["tracker.readout_time=0.02", "mapper.max_pixels=3072"])
def test_saved_images_are_those_of_a_run(tmp_path: Path, more: str) -> None:
    """Of a rolling shutter, and of training at a smaller size."""
    output = tmp_path / "run"
    words = [*SMALL, more, "tracker=ground_truth", "evaluator=off", "mapper.save_images=true", f"output={output}"]
    run_inline(compose([*words, f"dataset._target_={__name__}.Posed"]))
    with Mapping(*SMALL, more, poses=True, intrinsics=room()[0].intrinsics) as mapping:
        for item in room():
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
    saved = mapping.save(tmp_path / "saved")
    theirs = {file.name: file.read_bytes() for file in (output / "keyframes").iterdir()}
    ours = {file.name: file.read_bytes() for file in (saved / "keyframes").iterdir()}
    assert len(theirs) > 3
    assert ours.keys() == theirs.keys()
    assert ours == theirs
    assert mapping.warnings == []


def test_images_that_could_not_be_saved_are_said(tmp_path: Path) -> None:
    few = ["mapper.max_keyframes=3", "mapper.window=1"]
    with Mapping(*SMALL, *few, poses=True, intrinsics=room()[0].intrinsics) as mapping:
        for item in room():
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
    saved = mapping.save(tmp_path / "saved")
    missing = len(mapping.keyframes) - len(list((saved / "keyframes").iterdir()))
    assert missing > 0
    assert f"{missing} of {len(mapping.keyframes)} keyframes were saved without an image" in mapping.warnings[-1]
    count = len(mapping.warnings)
    mapping.save(saved, images=False)
    assert len(mapping.warnings) == count
    np.testing.assert_array_equal(np.isfinite(mapping.trajectory.world_from_cam).all(axis=(1, 2)), True)


def tracked(*more: str) -> Mapping:
    with Mapping(*SMALL, "tracker.threads=1", *more, intrinsics=room()[0].intrinsics) as mapping:
        for item in room():
            mapping.add(item.image, item.timestamp)
    return mapping


@pytest.mark.parametrize("more", ["tracker.readout_time=0.02", "mapper.max_pixels=3072"])
def test_images_of_a_map_that_is_gone_on_with_are_saved_again(tmp_path: Path, more: str) -> None:
    """Twice, into the map's own folder: their names change with the frames' numbers."""
    saved = tracked(more).save(tmp_path / "saved")
    before = {int(file.stem) - STREAM: file.read_bytes() for file in (saved / "keyframes").iterdir()}
    assert len(before) > 3
    again = Mapping.load(saved, *SMALL, more, intrinsics=room()[0].intrinsics)
    with pytest.raises(RuntimeError, match="no frame has come since the map was loaded"):
        again.save(saved)
    with again:
        again.add(room()[3].image, 0.0)
    for _ in range(2):
        again.save(saved)
        there = {int(file.stem): file.read_bytes() for file in (saved / "keyframes").iterdir()}
        assert {index: image for index, image in there.items() if index < 0} == before
        check_kept_map(saved)
    assert not any("without an image" in line for line in again.warnings)


def test_the_map_that_is_gone_on_with_is_not_exported_over(tmp_path: Path) -> None:
    saved = tracked().save(tmp_path / "saved", images=False)
    before = {name: (saved / name).read_bytes() for name in ("map.ply", "cameras.json")}
    again = Mapping.load(saved, *SMALL, intrinsics=room()[0].intrinsics)
    for name in before:
        for export in (again.export, again.map.export):
            with pytest.raises(ValueError, match="is what this map was loaded from: give another file"):
                export(saved / name)
    assert {name: (saved / name).read_bytes() for name in before} == before
    assert again.export(tmp_path / "map.ply").exists()


@pytest.mark.parametrize("step", ["writer.save", "results.write_ply"])
def test_a_map_whose_second_save_finds_no_room_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    mapping = tracked()
    saved = mapping.save(tmp_path / "saved")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"mvsgs_core.mapping.checkpoints.{step}", full)
    with pytest.raises(OSError, match="No space left"):
        mapping.save(saved)
    monkeypatch.undo()
    with Mapping.load(saved, *SMALL, intrinsics=room()[0].intrinsics) as again:
        found = again.add(room()[3].image, 0.0)
    assert found.world_from_cam is not None
