"""Frames of a stream that somebody else sends: what cannot belong to it is left out, counted and said."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from msgs import Frame
from mvsgs_core.camera import FOCAL_RANGE, is_near_middle
from mvsgs_core.printable import printable
from mvsgs_core.stats import Stats
from mvsgs_core.stream_times import LATEST, StreamTimes

MIN_SIDE, MAX_SIDE = 16, 16384  # pixels of a side
CLOCKS_END = 2.0**31  # seconds: what ROS 2 can say
BEHIND = 2.0  # s of delay that a user should know of
RUSHING = 100.0  # times as far as the time between two frames: stamps that advance so for `BRIEF` are no seconds
BRIEF = 1.0  # s
DRIFT = 5e-4  # that two clocks may run apart, one of them being set gently: 50 ppm alone make 2 s in 11 hours


class StreamFrames:
    """The frames of one sender, whom warnings name as `sender`.

    In the counts: `unusable` ones in all, and of these those that were `doubled`, late (`out_of_order`) or of an
    `other_size`. In the values: `delay`, seconds that the newest took longer to come than the promptest, by its stamp,
    less what two clocks may have run apart since.
    stamped: the sender says when it took them; one that only hands pictures on may give the same one again.
    """

    def __init__(self, stats: Stats, sender: str, stamped: bool = True) -> None:
        self.native: tuple[int, int] | None = None  # (height, width) of all, once the first has come
        self.refused = ""  # why the first frame that was left out was
        self.heard = 0.0  # by time.monotonic: when the last frame came that was no damaged or foreign one
        self._stats = stats
        self._sender = sender
        self._stamped = stamped
        self._times = StreamTimes()
        self._newest: Frame | None = None  # as it came
        self._restarted = False
        self._promptest = math.inf  # s from a frame's time to its coming, by two clocks
        self._timed = 0.0  # by time.monotonic: when the last frame's delay was taken
        self._shown = math.inf  # the last frame's time
        self._rushing: float | None = None  # by time.monotonic: since when stamps advance too far; None: they do not

    def restarted(self) -> None:
        """The sender's program started again: its clock may be another."""
        self._restarted = True

    def accept(self, frame: Frame) -> Frame | None:
        """The frame at a time after all before it; None, with a warning, if it cannot belong to the same stream."""
        wrong = self._fault(frame)
        if wrong is None:
            self.heard = time.monotonic()
        placed = wrong or self._placed(frame)
        if isinstance(placed, str):
            self.refuse(placed)
            return None
        self.native, self._newest = (frame.image.shape[0], frame.image.shape[1]), frame
        return replace(frame, timestamp=placed, stamp=frame.stamp or _stamp(frame.timestamp))

    def refuse(self, why: str) -> None:
        """One that was left out."""
        self.refused = self.refused or printable(why)
        self._stats.count("unusable")
        self._stats.warn(why)

    def _placed(self, frame: Frame) -> float | str:
        """Its time in the stream, or why it has none."""
        if self._doubled(frame):
            self._stats.count("doubled")
            return f"frames that {self._sender} gave twice were left out"
        shown = self._times.accept(frame.timestamp, self._restarted)
        self._restarted = False
        if shown is None:
            self._stats.count("out_of_order")
            return f"frames of {self._sender} from before, or hours after, those that came before were left out"
        if self._times.repaired > self._stats.counts.get("times_repaired", 0):
            self._stats.counts["times_repaired"] = self._times.repaired
            self._stats.warn(
                f"{self._sender}'s timestamps stood still, went back or leapt: there the time here was taken"
            )
        if self._stamped:
            self._note_delay(time.monotonic(), shown)
        return shown

    def _note_delay(self, now: float, shown: float) -> None:
        self._note_unit(now, shown)
        lag = now - shown
        self._promptest, self._timed = min(self._promptest + DRIFT * (now - self._timed), lag), now
        delay = lag - self._promptest
        self._stats.values["delay"] = round(delay, 2)
        if delay > BEHIND:
            self._stats.warn(
                f"frames of {self._sender} come more than {BEHIND:g} s later than they should by their timestamps: the "
                "link, or the program that sends them, is slower than the stream"
            )

    def _note_unit(self, now: float, shown: float) -> None:
        """Of stamps that advance much farther than the time in which frames come."""
        if shown - self._shown <= RUSHING * (now - self._timed):
            self._rushing = None
        elif self._rushing is None:
            self._rushing = self._timed
        elif now - self._rushing > BRIEF:
            self._stats.warn(
                f"{self._sender}'s timestamps advance over {RUSHING:g} times as fast as its frames come: they look "
                "like milliseconds, and must be seconds"
            )
        self._shown = shown

    def _doubled(self, frame: Frame) -> bool:
        last = self._newest
        if last is None or (self._stamped and frame.timestamp != last.timestamp):
            return False
        same_rows = np.array_equal(frame.image[::16], last.image[::16])  # most pictures differ there
        return same_rows and np.array_equal(frame.image, last.image)

    def _fault(self, frame: Frame) -> str | None:
        native = frame.image.shape[0], frame.image.shape[1]
        side = max(native)
        focal = frame.intrinsics[:2]
        if not MIN_SIDE <= min(native) <= side <= MAX_SIDE:
            return f"frames with sides outside of {MIN_SIDE} to {MAX_SIDE} pixels were left out, such as {native}"
        if self.native not in (None, native):
            self._stats.count("other_size")
            return f"frames of another size than the first, {self.native}, were left out, such as {native}"
        in_view = np.all((FOCAL_RANGE[0] * side <= focal) & (focal <= FOCAL_RANGE[1] * side))
        if not abs(frame.timestamp) <= LATEST:
            return f"frames whose timestamp is no time in seconds (beyond {LATEST:g}) were left out"
        if not in_view or not is_near_middle(frame.intrinsics, native):
            return f"frames without valid intrinsics were left out, such as {frame.intrinsics.tolist()} for {native}"
        return None


def _stamp(timestamp: float) -> int:
    """Nanoseconds, in whole microseconds, of the sender's own time, which the one in the stream may be off from; 0:
    of a time that is none of a clock."""
    return 1000 * round(1e6 * timestamp) if 0.0 < timestamp < CLOCKS_END else 0
