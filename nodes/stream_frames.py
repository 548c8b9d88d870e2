"""Frames of a stream that somebody else sends: what cannot belong to it is left out, counted and said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msgs import Frame
from mvsgs_core.stats import Stats
from nodes.stream_times import LATEST, StreamTimes

FOCAL_RANGE = 0.02, 100.0  # of the larger side of the image: beyond a fisheye and a telescope nothing can be tracked
MIN_SIDE, MAX_SIDE = 16, 16384  # pixels of a side


class StreamFrames:
    """The frames of one sender, whom warnings name as `sender`."""

    def __init__(self, stats: Stats, sender: str) -> None:
        self.native: tuple[int, int] | None = None  # (height, width) of all, once the first has come
        self._stats = stats
        self._sender = sender
        self._times = StreamTimes()

    def accept(self, frame: Frame) -> Frame | None:
        """The frame at a time after all before it; None, with a warning, if it cannot belong to the same stream."""
        wrong = self._fault(frame)
        shown = None if wrong else self._times.accept(frame.timestamp)
        if shown is None:
            self.refuse(wrong or f"frames whose timestamp is no time in seconds (beyond {LATEST:g}) were left out")
            return None
        if self._times.repaired > self._stats.counts.get("times_repaired", 0):
            self._stats.counts["times_repaired"] = self._times.repaired
            self._stats.warn(
                f"{self._sender}'s timestamps stood still, went back or leapt: there the time here was taken"
            )
        self.native = self.native or (frame.image.shape[0], frame.image.shape[1])
        return replace(frame, timestamp=shown)

    def refuse(self, why: str) -> None:
        """One that was left out."""
        self._stats.count("unusable")
        self._stats.warn(why)

    def _fault(self, frame: Frame) -> str | None:
        native = frame.image.shape[0], frame.image.shape[1]
        side = max(native)
        focal, center = frame.intrinsics[:2], frame.intrinsics[2:]
        if not MIN_SIDE <= min(native) <= side <= MAX_SIDE:
            return f"frames with sides outside of {MIN_SIDE} to {MAX_SIDE} pixels were left out, such as {native}"
        if self.native not in (None, native):
            return f"frames of another size than the first, {self.native}, were left out, such as {native}"
        in_view = np.all((FOCAL_RANGE[0] * side <= focal) & (focal <= FOCAL_RANGE[1] * side))
        if not in_view or not np.all(np.abs(center) <= 2 * side):
            return f"frames without valid intrinsics were left out, such as {frame.intrinsics.tolist()} for {native}"
        return None
