"""What the mapper node leaves on the disk while a stream runs: checkpoints, and maps that are asked for."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from msgs import Preview, Reply, Request
from mvsgs_core.kept_map import tracker_file
from mvsgs_core.mapping.checkpoints.files import checkpoint_info, state_file
from mvsgs_core.mapping.checkpoints.saved_map import SavedMap
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from nodes.mapper import Mapper
from nodes.ros2_services import newest
from tests.support.full_disk import full_after
from tests.support.mapper_messages import settings, view_message
from tests.support.patience import LONG, until


def mapped() -> Mapper:
    node = Mapper(settings())
    for k in range(2):
        list(node.on_fused_keyframe(view_message(7 * k, k / 2)))
    return node


def tracker_half(folder: Path) -> Path:
    """What a request that reaches the mapper finds there."""
    file = tracker_file(folder)
    file.parent.mkdir(parents=True)
    file.write_bytes(b"as the tracker left it")
    return file


def asked_on_a_full_disk(node: Mapper, request: Request) -> Reply:
    with full_after(5_000), pytest.MonkeyPatch.context() as patched:  # which says that the file is too large
        patched.setattr("mvsgs_core.mapping.checkpoints.writer.FULL", (errno.EFBIG,))
        replies: list[Reply] = [m for m in node.on_request(request) if isinstance(m, Reply)]
        replies += list(node._saved.replies(wait=True))
    (reply,) = replies
    assert not reply.success
    assert "make room" in reply.message
    return reply


def test_a_stream_that_pauses_is_saved_though_there_is_nothing_to_do(tmp_path: Path) -> None:
    node = Mapper(replace(settings(output=str(tmp_path)), realtime=True))
    for k in range(4):
        list(node.on_fused_keyframe(view_message(7 * k, k / 4)))
    while node.on_idle() is not None:
        pass
    checkpoints = node._checkpoints
    assert checkpoints is not None
    clock = checkpoints._clock
    checkpoints._clock = lambda: clock() + 3600.0
    for _ in range(20):
        assert node.on_idle() is None
        assert checkpoints._writer.wait(LONG)
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 7, 14, 21]
    assert node.stats.counts["checkpoints"] == 2, "the first, and one of the map at rest"


def test_a_map_that_another_takes_the_place_of_stays_until_it_is_written(tmp_path: Path) -> None:
    node, half = mapped(), tracker_half(tmp_path / "kept")
    reply = asked_on_a_full_disk(node, Request(1, "reset", kept=str(tmp_path / "kept")))
    assert "in memory until it can be written" in reply.message
    assert not node.atlas.current.views, "tracker, stereo and fusion have another map by now"
    clock = node._saved._clock
    node._saved._clock = lambda: clock() + 3600.0

    def written() -> bool:
        node.on_idle()
        return not node._saved._left

    until(written)
    assert checkpoint_info(tmp_path / "kept").keyframes.tolist() == [0, 7]
    assert half.is_file()
    assert "there was room at last" in node.stats.warnings[-1]


def test_of_a_map_that_was_not_saved_no_half_stays(tmp_path: Path) -> None:
    node = mapped()
    tracker_half(tmp_path / "saved")
    asked_on_a_full_disk(node, Request(1, "save_map", folder=str(tmp_path / "saved")))
    assert list(tmp_path.rglob("*.npz")) == []
    assert len(node.atlas.current.views) == 2
    tracker_half(tmp_path / "kept")
    asked_on_a_full_disk(node, Request(2, "reset", kept=str(tmp_path / "kept")))
    with full_after(5_000):
        node.on_abort("the run was stopped")
    assert list(tmp_path.rglob("*.npz")) == []
    assert "is not whole" in node.stats.warnings[-1]


def test_a_run_that_ends_early_waits_for_the_map_that_is_being_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write: Callable[..., None] = CheckpointWriter._write
    monkeypatch.setattr(CheckpointWriter, "_write", lambda *given: (time.sleep(0.5), write(*given)))
    node = mapped()
    assert list(node.on_request(Request(1, "reset", kept=str(tmp_path)))) == []
    node.on_abort("the run was stopped")
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 7]


def test_a_map_that_could_not_be_written_is_done_once_it_is_known_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write: Callable[..., None] = CheckpointWriter._write
    told = threading.Event()

    def slowly(*given: Any) -> None:
        try:
            write(*given)
        finally:
            assert told.wait(LONG)

    def no_room(*_: Any) -> None:
        raise OSError("no room")

    monkeypatch.setattr(CheckpointWriter, "_write", slowly)
    monkeypatch.setattr(CheckpointWriter, "_write_state", no_room)
    saved = SavedMap(mapped().atlas, settings(), tmp_path)
    until(lambda: not saved._writer.busy)
    assert not saved.done
    told.set()
    until(lambda: saved.done)
    assert "no room" in saved.problem


def test_the_newest_map_has_both_halves(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no map"):
        newest(tmp_path)
    whole, half = tracker_half(tmp_path / "whole"), tracker_half(tmp_path / "half")
    state_file(tmp_path / "whole", 1).touch()
    os.utime(whole, ns=(0, half.stat().st_mtime_ns - 10**9))
    assert newest(tmp_path) == str(tmp_path / "whole")


def test_a_map_that_is_begun_on_is_shown_before_a_keyframe_comes(tmp_path: Path) -> None:
    CheckpointWriter(tmp_path, settings()).write(mapped().atlas.frozen())

    def shown(node: Mapper) -> list[int]:
        previews = [m for _ in range(3) for m in node.on_idle() or () if isinstance(m, Preview)]
        return [len(preview.keyframes) for preview in previews]

    begun = Mapper(settings(map=str(tmp_path), preview_period=1.0))
    assert shown(begun) == [2]
    other = Mapper(settings(preview_period=1.0))
    (reply,) = other.on_request(Request(1, "load_map", folder=str(tmp_path), kept=str(tmp_path / "kept")))
    assert isinstance(reply, Reply)
    assert reply.success
    assert shown(other) == [2]
