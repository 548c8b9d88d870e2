"""Many frames at a time, each on a core of its own: most of what scoring does to one frame runs on one core."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

from mvsgs_core.rasterizer.splats import Splats

T = TypeVar("T")
R = TypeVar("R")

MAX_BYTES = 2e9  # of all frames at a time, where there is more than one
PIXEL, SPLAT = 280, 150  # bytes that a frame takes of each, measured: SSIM's doubles, the rasterizer's lists


def each(of: Callable[[T], R], frames: Iterable[T], size: tuple[int, int], splats: Splats) -> Iterator[R]:
    """`of` each frame, in their order. size: height and width of an image; splats: what is rendered.

    What PyTorch and the rasterizer may use of the cores is shared among the frames at work. With one core, or frames
    that are too large to lie in memory beside each other, it is one after the other.
    """
    threads = torch.get_num_threads()
    room = MAX_BYTES // (PIXEL * size[0] * size[1] + SPLAT * len(splats.means))
    workers = int(max(1, min(threads, room)))
    if workers == 1:
        yield from map(of, frames)
        return
    try:  # PyTorch's number of threads is of the thread that sets it, and of those that begin later
        with ThreadPoolExecutor(workers, "frame", torch.set_num_threads, (max(1, threads // workers),)) as pool:
            yield from pool.map(of, frames)
    finally:
        torch.set_num_threads(threads)


__all__ = ["each"]
