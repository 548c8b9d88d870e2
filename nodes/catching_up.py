"""Which frames of a live stream a tracker takes up, of those that came while it was at work for long.

The newest alone, where the camera is followed to it. In a fast turn it is not, and would be lost: then they are taken
up in their order, the fewer of them the more wait, until none does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from msgs import Frame
from mvsgs_core.tracking.phase import Phase

PASSED_OVER = "frames that newer ones overtook: not tracked"
KEPT = 30  # frames that wait, at most: about a second
HOP = 6  # frames that wait let one more of them be passed over


class CatchingUp:
    """The frames that wait."""

    def __init__(self) -> None:
        self.passed_over = 0  # frames that were never taken
        self._frames: list[Frame] = []
        self._in_order = False

    @property
    def behind(self) -> bool:
        """Whether any frame waits."""
        return bool(self._frames)

    def came(self, frames: Sequence[Frame]) -> None:
        """The newest frame, behind those that it overtook."""
        waiting = [*self._frames, *frames]
        self.passed_over += max(0, len(waiting) - KEPT)
        self._frames = waiting[-KEPT:]

    def take(self, phase: Phase, follows: Callable[[Frame], bool]) -> Frame:
        """The one that is next; those before it are passed over. At least one waits.

        phase: of the tracker. follows: whether it would follow the camera to a frame. While a start is sought all count
        alike, as none gets a pose; a lost camera is looked for in the newest.
        """
        frames, begins = self._frames, phase is Phase.INITIALIZING
        if len(frames) == 1 or phase in (Phase.LOST, Phase.RELOCALIZING):
            self._in_order = False
        elif not begins and not self._in_order:
            self._in_order = not follows(frames[-1])
        taken = 1 + (len(frames) - 1) // HOP if begins or self._in_order else len(frames)
        self.passed_over += taken - 1
        self._frames = frames[taken:]
        return frames[taken - 1]

    def forget(self) -> None:
        """Another map begins."""
        self.passed_over += len(self._frames)
        self._frames = []


__all__ = ["KEPT", "PASSED_OVER", "CatchingUp"]
