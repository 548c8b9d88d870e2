"""Frames scored beside each other: the same figures in the same order, and no more at a time than memory holds."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
import torch

from mvsgs_core.evaluation import many_frames
from mvsgs_core.rasterizer.splats import Splats
from tests.support.small_maps import empty_map

SIZE = (48, 64)


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def threads_at_work(size: tuple[int, int], splats: Splats, at_a_time: int) -> int:
    """Of so many frames; each waits until the others of its time are at work, too."""
    working, most, lock, together = 0, 0, threading.Lock(), threading.Barrier(at_a_time, timeout=30)

    def work(_: int) -> int:
        nonlocal working, most
        with lock:
            working += 1
            most = max(most, working)
        together.wait()
        with lock:
            working -= 1
        return torch.get_num_threads()

    threads = list(many_frames.each(work, range(8), size, splats))
    assert threads == [2 // most] * 8, "PyTorch's threads are shared among the frames at work"
    assert torch.get_num_threads() == 2
    return most


def test_as_many_at_a_time_as_there_are_threads_unless_they_are_too_large() -> None:
    assert threads_at_work(SIZE, empty_map(), 2) == 2
    assert threads_at_work((4000, 6000), empty_map(), 1) == 1


def test_they_come_in_their_order() -> None:
    def slow_first(n: int) -> int:
        time.sleep(0.05 if n == 0 else 0.0)
        return n

    assert list(many_frames.each(slow_first, range(6), SIZE, empty_map())) == list(range(6))


def test_a_frame_that_cannot_be_scored_ends_it() -> None:
    def bad(n: int) -> int:
        if n == 3:
            raise ValueError("frame 3")
        return n

    with pytest.raises(ValueError, match="frame 3"):
        list(many_frames.each(bad, range(6), SIZE, empty_map()))
    assert torch.get_num_threads() == 2
