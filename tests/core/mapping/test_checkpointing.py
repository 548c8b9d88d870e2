"""When checkpoints are made, what they cost, and what is left where one cannot be."""

from __future__ import annotations

import errno
import os
import tempfile
import time
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvsgs_core.datasets.lens import Lens
from mvsgs_core.export.cameras import read_source_camera
from mvsgs_core.export.ply import read_ply
from mvsgs_core.export.source_camera import GIVEN, SourceCamera
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints import checkpointing, writer
from mvsgs_core.mapping.checkpoints.checkpointing import MAX_FRACTION, Checkpointing
from mvsgs_core.mapping.checkpoints.files import FOLDER, checkpoint_info, state_files
from mvsgs_core.mapping.checkpoints.results import write_results
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.resting_images import rest
from mvsgs_core.trajectory_file import read_trajectory
from nodes.runtime.explained import is_explained
from tests.support.full_disk import full_after
from tests.support.patience import LONG
from tests.support.small_atlas import PLAIN, begun, view


class Clock:
    """Goes on by what each look at it takes, and by hand."""

    def __init__(self, look: float = 0.0) -> None:
        self.now, self.look = 100.0, look

    def __call__(self) -> float:
        self.now += self.look
        return self.now


def times(checkpoints: Checkpointing, atlas: Atlas) -> float:
    """How often was saved so far, after a look."""
    checkpoints.keep(atlas)
    assert checkpoints._writer.wait(LONG)
    return atlas.current.log.counts.get("checkpoints", 0)


def test_the_first_checkpoint_is_made_as_soon_as_there_is_a_map(tmp_path: Path) -> None:
    atlas = Atlas(OnlineMapper(PLAIN))
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=Clock())
    assert times(checkpoints, atlas) == 0
    atlas.enter(0)
    atlas.current.add_keyframe(replace(view(0), depth=np.zeros((24, 32), np.float32), normals=None))
    assert times(checkpoints, atlas) == 0
    atlas.current.add_keyframe(view(2))
    assert times(checkpoints, atlas) == 1
    assert times(checkpoints, atlas) == 1
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 2]


def test_the_period_is_of_the_stream_or_of_the_clock(tmp_path: Path) -> None:
    atlas, clock = begun(PLAIN), Clock()
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=clock)
    assert times(checkpoints, atlas) == 1
    atlas.revision += 1
    clock.now += 29.0
    assert times(checkpoints, atlas) == 1
    clock.now += 2.0
    assert times(checkpoints, atlas) == 2
    atlas.came(6, 29.0)
    assert times(checkpoints, atlas) == 2
    atlas.came(7, 30.6)
    assert times(checkpoints, atlas) == 3
    atlas.came(8, float("nan"))
    assert times(checkpoints, atlas) == 3


def test_a_map_that_stays_as_it_is_is_saved_once(tmp_path: Path) -> None:
    atlas, clock = begun(PLAIN), Clock()
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=clock)
    assert times(checkpoints, atlas) == 1
    clock.now += 1000.0
    assert times(checkpoints, atlas) == 1
    atlas.step()
    assert times(checkpoints, atlas) == 2
    clock.now += 1000.0
    assert times(checkpoints, atlas) == 2


def test_the_period_grows_where_checkpoints_would_take_too_much_of_the_time(tmp_path: Path) -> None:
    atlas, clock = begun(PLAIN), Clock(look=1.0)  # two looks in each: a second a checkpoint
    checkpoints = Checkpointing(tmp_path, 10.0, atlas, clock=clock)
    began, made = clock.now, []
    while clock.now < began + 1000.0:
        atlas.revision += 1
        if times(checkpoints, atlas) > len(made):
            made.append(clock.now - began)
    assert made[0] < 5.0
    assert np.diff(made).min() >= 1.0 / MAX_FRACTION * 0.9
    assert 15 <= len(made) <= MAX_FRACTION * 1000.0


def test_no_checkpoint_is_made_without_a_period(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 0.0, atlas)
    assert times(checkpoints, atlas) == 0
    checkpoints.last(atlas)
    assert not (tmp_path / FOLDER).exists()
    assert len(read_ply(tmp_path / "map.ply").splats) == len(atlas.largest.state)


def test_every_checkpoint_leaves_a_map_and_the_keyframes_poses(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    assert times(Checkpointing(tmp_path, 30.0, atlas), atlas) == 1
    found, final = read_ply(tmp_path / "map.ply"), atlas.largest.snapshot()
    np.testing.assert_allclose(found.splats.means.numpy(), final.splats.means.numpy() + final.origin, atol=1e-5)
    seconds, poses = read_trajectory(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(seconds, [0.0, 0.1, 0.2, 0.4, 0.5])  # of the largest part
    np.testing.assert_allclose(poses, final.world_from_cam, atol=1e-6)


def test_a_full_disk_is_said_and_the_checkpoint_before_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "FULL", (errno.EFBIG,))  # `full_after` says that the file is too large
    atlas, clock = begun(PLAIN), Clock()
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=clock)
    assert times(checkpoints, atlas) == 1
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    clock.now += 40.0
    atlas.current.add_keyframe(view(7))
    with full_after(5_000):
        assert times(checkpoints, atlas) == 2
        checkpoints.keep(atlas)
    assert any("make room" in text and "File too large" in text for text in atlas.current.log.warnings)
    after = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    assert {file: after[file] for file in before} == before
    assert not any(file.name.startswith(".") for file in after)
    clock.now += 40.0
    assert times(checkpoints, atlas) == 3
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 1, 2, 3, 4, 5, 7]


@pytest.mark.parametrize(
    ("number", "of", "said"),
    [
        (errno.ENOSPC, "save", "no checkpoint can be written to {}/checkpoint: "),
        (errno.EACCES, "save", "no checkpoint can be written to {}/checkpoint: "),
        (errno.EROFS, "write_image", "no checkpoint can be written to {}/checkpoint: "),
        (errno.EIO, "write_results", "map.ply and what lies beside it cannot be written to {}: "),
        (errno.ENOSPC, "write_results", "map.ply and what lies beside it cannot be written to {}: "),
        (errno.EACCES, "CheckpointWriter._remove_others", "earlier checkpoints cannot be removed from {}/checkpoint: "),
    ],
)
def test_what_cannot_be_written_is_named_and_room_is_asked_for_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, of: str, said: str
) -> None:
    atlas, clock = begun(PLAIN), Clock()
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=clock)
    assert times(checkpoints, atlas) == 1

    def failing(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(f"mvsgs_core.mapping.checkpoints.writer.{of}", failing)
    clock.now += 40.0
    atlas.current.add_keyframe(view(7))
    assert times(checkpoints, atlas) == 2
    checkpoints.keep(atlas)
    (problem,) = [text for text in atlas.current.log.warnings if os.strerror(number) in text]
    assert problem == (
        f"{said.format(tmp_path)}{os.strerror(number)}; the run goes on and the last checkpoint stays"
        + (": make room there" if number == errno.ENOSPC else "")
    )
    state_there = of not in ("save", "write_image")
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 1, 2, 3, 4, 5] + [7] * state_there
    monkeypatch.undo()
    clock.now += 40.0
    assert times(checkpoints, atlas) == 3, "it is to be saved still"
    assert len(state_files(tmp_path)) == 2


def test_a_final_map_that_cannot_be_written_is_an_error_and_leaves_the_one_before(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas)
    assert times(checkpoints, atlas) == 1
    before = (tmp_path / "map.ply").read_bytes()
    with full_after(5_000), pytest.raises(OSError, match="File too large"):
        checkpoints.finish(atlas)
    assert (tmp_path / "map.ply").read_bytes() == before
    assert checkpoint_info(tmp_path).splats == len(atlas.largest.state)


class FullDisk:
    """Has no room in a folder, for so many attempts."""

    def __init__(self, folder: Path, attempts: float) -> None:
        self.folder, self.attempts = folder, attempts

    def __call__(self, output: Path, *given: Any, **named: Any) -> int:
        if output == self.folder and self.attempts > 0:
            self.attempts -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_results(output, *given, **named)


def test_the_finished_map_waits_for_room_on_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas, rests = begun(PLAIN), []
    monkeypatch.setattr(checkpointing, "write_results", FullDisk(tmp_path, 3))
    monkeypatch.setattr(checkpointing, "BETWEEN", 0.0)
    size = Checkpointing(tmp_path, 0.0, atlas, clock=Clock(1.0)).finish(atlas, rest=lambda: rests.append(1))
    assert size == (tmp_path / "map.ply").stat().st_size
    assert len(rests) == 3
    assert any(f"finds no room in {tmp_path}: No space left" in text for text in atlas.current.log.warnings)


def test_a_finished_map_that_finds_no_room_is_put_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas, other = begun(PLAIN), tmp_path / "other"
    other.mkdir()
    monkeypatch.setattr(checkpointing, "write_results", FullDisk(tmp_path, np.inf))
    monkeypatch.setattr(checkpointing, "BETWEEN", 0.0)
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    with pytest.raises(OSError, match=f"cannot be written to {tmp_path}: No space left on device; it is in") as raised:
        Checkpointing(tmp_path, 0.0, atlas, clock=Clock(1.0)).finish(atlas)
    (folder,) = other.iterdir()
    assert str(raised.value).endswith(str(folder))
    assert is_explained(raised.value), "in its message alone"
    assert len(read_ply(folder / "map.ply").splats) == len(atlas.current.state)


def test_a_finished_map_that_finds_no_room_at_all_says_of_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    atlas = begun(PLAIN)
    monkeypatch.setattr(checkpointing, "write_results", FullDisk(tmp_path, np.inf))
    monkeypatch.setattr(checkpointing, "BETWEEN", 0.0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    said = (
        f"cannot be written to {tmp_path}: No space left on device; nor to a folder for temporary files: No such file"
    )
    with pytest.raises(OSError, match=said):
        Checkpointing(tmp_path, 0.0, atlas, clock=Clock(1.0)).finish(atlas)


def test_the_last_checkpoint_of_a_run_that_ends_early_is_there_at_once(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas)
    checkpoints.keep(atlas)  # is being written, perhaps
    atlas.current.add_keyframe(view(8))
    atlas.came(8, 0.8)
    for added in atlas.current.views:
        checkpoints.added(added)
    start = time.perf_counter()
    checkpoints.last(atlas)
    assert time.perf_counter() - start < 3.0
    assert checkpoint_info(tmp_path).newest_keyframe_index == 8
    assert len(read_ply(tmp_path / "map.ply").splats) == len(atlas.current.state)
    assert not atlas.current.log.counts.get("refused_checkpoints")


def test_a_map_that_was_cut_off_in_a_change_leaves_the_checkpoint_before(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas)
    assert times(checkpoints, atlas) == 1
    atlas.current.state.anchors = atlas.current.state.anchors[:-1]
    checkpoints.last(atlas)
    assert any("middle of a change" in text for text in atlas.current.log.warnings)
    assert [file.name for file in state_files(tmp_path)] == ["state-00000001.npz"]


def test_the_checkpoint_of_a_finished_map_is_made_where_wanted(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas)
    assert times(checkpoints, atlas) == 1
    atlas.stream_ended, atlas.refined = True, 6
    source = SourceCamera(Lens((30.0, 30.0, 16.0, 12.0), (24, 32), ()), GIVEN)
    checkpoints.finish(atlas, source)
    checkpoints.close(atlas, keep=False)
    assert not checkpoint_info(tmp_path).finished  # the one before: its report may still be to be made
    checkpoints.close(atlas, keep=True)
    assert checkpoint_info(tmp_path).finished
    assert (tmp_path / "map.ply").exists()
    assert read_source_camera(tmp_path / "cameras.json") == source


def test_earlier_checkpoints_that_cannot_be_removed_cost_no_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas, clock=Clock())
    assert times(checkpoints, atlas) == 1

    def refused(self: CheckpointWriter) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(CheckpointWriter, "keep_newest", refused)
    checkpoints.close(atlas, keep=True)
    said = f"earlier checkpoints cannot be removed from {tmp_path / FOLDER}: Read-only file system"
    assert said in atlas.current.log.warnings
    assert len(state_files(tmp_path)) == 2
    assert checkpoint_info(tmp_path).file == state_files(tmp_path)[0]


def test_a_copy_that_is_written_is_let_go(tmp_path: Path) -> None:
    checkpoints, copy = CheckpointWriter(tmp_path, PLAIN), begun(PLAIN).frozen()
    written = weakref.ref(copy)
    checkpoints.submit(copy)
    del copy
    assert checkpoints.wait(LONG)
    assert written() is None


def test_an_image_that_went_to_disk_is_not_kept_in_memory_for_its_name(tmp_path: Path) -> None:
    atlas = begun(PLAIN)
    checkpoints, (first, *_) = CheckpointWriter(tmp_path, PLAIN), atlas.current.views
    in_memory = weakref.ref(first.image)
    checkpoints.prepare(first)
    assert checkpoints.wait(LONG)
    files = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.png")}
    assert len(files) == 1
    assert rest(first, atlas.current.log)
    assert in_memory() is None
    checkpoints.prepare(first)
    assert checkpoints.wait(LONG)
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.png")} == files


def test_what_a_killed_process_left_half_written_goes_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "keyframes").mkdir()
    left = [tmp_path / name for name in (".map.1.ply", ".cameras.1.json", ".transforms.1.json", "keyframes/.7.1.png")]
    for file in left:
        file.write_text("of a process that was killed")
    atlas = begun(PLAIN)
    checkpoints = Checkpointing(tmp_path, 30.0, atlas)
    assert not any(file.exists() for file in left)
    being_written = tmp_path / "keyframes" / f".000008.{os.getpid()}.png"
    being_written.touch()
    assert times(checkpoints, atlas) == 1
    assert being_written.exists()
