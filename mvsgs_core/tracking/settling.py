"""Frames before a keyframe that are posed again, now that the map has it: at once, or one by one as there is time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import Between

TIMED = "frames between keyframes"


class Settling:
    """What is left to do for the frames before one keyframe."""

    def __init__(
        self, frames: frozenset[int], jobs: Iterable[Callable[[], bool]], last: Callable[[], tuple[Between, ...]],
        stats: Stats,
    ) -> None:  # fmt: skip
        """frames: whose images are needed until then. jobs: pose a frame each, and say whether they could.

        last: gives the frames that may go out.
        """
        self.frames, self._jobs, self._last, self._stats = frames, deque(jobs), last, stats

    def step(self) -> bool:
        """Poses one frame; False when none is left."""
        if not self._jobs:
            return False
        with self._stats.time(TIMED):
            self._stats.count("frames posed from both sides", self._jobs.popleft()())
        return True

    def finish(self) -> tuple[Between, ...]:
        """The frames that may go out, those that were not posed again where they were seen first. To be called once."""
        if self._jobs:
            self._stats.skip("frames between keyframes that there was no time to pose again", len(self._jobs))
            self._jobs.clear()
        with self._stats.time(TIMED):
            return self._last()

    def whole(self) -> tuple[Between, ...]:
        """All of it at once."""
        while self.step():
            pass
        return self.finish()


__all__ = ["Settling"]
