"""Maps that are being saved on request, the replies to who asked, and what is done where a disk has no room.

Of a map that others take the place of, the copy in memory is the last one: tracker, stereo and fusion went on when the
request passed them. So it stays there until it is written.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

from msgs import Reply
from mvsgs_core.mapping.checkpoints.saved_map import SavedMap
from mvsgs_core.stats import Stats

AGAIN = 10.0  # s between two tries to write a map that found no room
ABORT, END = 2.8, 60.0  # s for what is being written, where the run ends early and where it does not


class SavedMaps:
    def __init__(self, stats: Stats, clock: Callable[[], float] = time.monotonic) -> None:
        self._stats, self._clock = stats, clock
        self._saving: deque[tuple[SavedMap, Reply, bool]] = deque()
        self._left: list[SavedMap] = []  # maps that found no room, with no other copy
        self._tried = 0.0

    def begin(self, saved: SavedMap, reply: Reply, last: bool) -> None:
        """reply: where it is written. last: the mapper goes on with another map."""
        self._saving.append((saved, reply, last))

    def replies(self, wait: bool = False) -> Iterator[Reply]:
        """Of the maps that are written by now, in the order in which they were asked for; others are tried again."""
        while self._saving and (wait or self._saving[0][0].done):
            saved, reply, last = self._saving.popleft()
            saved.wait()
            problem = saved.problem
            if problem and last:
                self._left.append(saved)
                self._tried = self._clock()
                problem = f"not yet, it is in memory until it can be written: {problem}"
            elif problem:
                saved.drop()
            yield replace(reply, success=False, message=f"{reply.message}: {problem}") if problem else reply
        self._look_after(again=self._clock() - self._tried >= AGAIN)

    def close(self, seconds: float = END) -> None:
        """The run ends: what is being written has so long, and what found no room is tried a last time."""
        until = time.monotonic() + seconds
        self._look_after(again=True)
        for saved in [*(saved for saved, _, _ in self._saving), *self._left]:
            done = saved.wait(max(0.0, until - time.monotonic()))
            problem = saved.problem if done else "there was no time to write it"
            if problem:
                self._stats.warn(f"a map that was to be saved is not whole, {saved.what}: {problem}")
            if problem and done:
                saved.drop()
        self._saving.clear()
        self._left.clear()

    def _look_after(self, again: bool) -> None:
        """Maps that found no room: those that are written by now are done, the others are tried again."""
        for saved in [saved for saved in self._left if saved.done]:
            if not saved.problem:
                self._left.remove(saved)
                self._stats.warn(f"there was room at last for the map in {saved.what}")
            elif again:
                saved.write()
                self._tried = self._clock()


__all__ = ["ABORT", "AGAIN", "END", "SavedMaps"]
