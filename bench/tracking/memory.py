"""Memory of the tracker over a long stream: a camera that goes around a room again and again, never twice the same way.

Frames are rendered as they are needed, in the process that is measured: the scene is in its resident memory from the
start and does not grow. What was freed is given back to the system before each sample (glibc keeps it otherwise), so
that what the tracker holds is counted, and not what building the scene or one bundle adjustment needed for a while.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import psutil

from bench.table import Row, at_most
from mvsgs_core.datasets import open_dataset
from mvsgs_core.tracking.tracker import Tracker

SETTLED = 500  # frames after which nothing may grow but what a keyframe needs
GROWTH = 1.25  # memory of a keyframe at the end over that after SETTLED frames: what counts as flat


@dataclass(frozen=True)
class Sample:
    frames: int
    keyframes: int
    megabytes: float  # resident, above what it was before the first frame


def follow(frames: int, every: int = 100) -> list[Sample]:
    """Tracks so many frames of the room; a sample after each `every`. For a process of its own."""
    cv2.setNumThreads(1)
    tracker = Tracker()
    samples: list[Sample] = []
    before = 0.0
    for number, item in enumerate(open_dataset("synthetic", frames=frames, threads=1), start=1):
        before = before or _resident()
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        if number % every == 0:
            samples.append(Sample(number, len(tracker.session.graph.keyframes), _resident() - before))
    return samples


def _resident() -> float:
    """Megabytes of this process, without what was freed (where the C library can tell)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    return float(psutil.Process().memory_info().rss / 1e6)


def rows(samples: Sequence[Sample]) -> list[Row]:
    """samples: at least one after SETTLED frames and one later."""
    last = samples[-1]
    settled = next(s for s in samples if s.frames >= SETTLED)
    name = f"{last.frames} frames of the room"

    def each(sample: Sample) -> float:
        return sample.megabytes / sample.keyframes

    return [
        Row(f"{name}: keyframes", last.keyframes, f"(after {settled.frames} frames: {settled.keyframes})"),
        Row(f"{name}: resident memory of the tracker", last.megabytes, f"MB (then: {settled.megabytes:.0f})"),
        at_most(
            f"{name}: memory of a keyframe over that after {settled.frames}",
            each(last) / each(settled),
            f"x ({each(last):.2f} MB)",
            GROWTH,
        ),
    ]
