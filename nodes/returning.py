"""What a tracker leaves while it runs, for a process that is started in its place once it was killed.

Its keyframes with their matches, as a map that is kept has them, saved whenever that takes little of its time; and,
line by line, what was sent, which readers have whatever became of the tracker since.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from msgs import Keyframe, Message, Poses, Request
from mvsgs_core.stats import Stats
from mvsgs_core.tracking import known_map
from mvsgs_core.tracking.known_map import KnownMap
from mvsgs_core.tracking.tracker import Tracker

SHARE = 0.02  # of the time that saving may take
MODE, ANOTHER = "Frozen", "Another"  # lines of the log that name no message


class Returning:
    def __init__(self, folder: Path, stats: Stats, clock: Callable[[], float] = time.monotonic) -> None:
        """folder: of this node and run alone; what an earlier process left in it is gone on with."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, folder / "tracker.npz"
        self._stats, self._clock = stats, clock
        self._due = 0.0
        self._changed = False
        self.revision = 0  # of the newest corrections that were sent
        self.frozen = False  # frames were only found in the map, as was asked for
        self.met: set[int] = set()  # requests
        self.newest = -1  # frame of the map that the earlier process had, up to which none is taken again
        self._sent: set[int] = set()  # keyframes of the map that it had
        self._log = folder / "sent"
        self._gap = folder / "not all of it"  # there: the log lacks lines, which a full disk has cost
        self._lost = self._gap.exists()
        self.returned = self._lost or self._log.exists()  # in an earlier process's place
        self.another: int | None = None  # request for another map than the run began on, the newest
        for line in self._log.read_text().splitlines() if self._log.exists() else ():
            kind, _, number = line.removesuffix(";").partition(" ")
            if not line.endswith(";"):
                continue  # cut off
            if kind == Keyframe.__name__ and number.isdecimal():
                self._sent.add(int(number))
                self.newest = int(number)
            elif kind == Poses.__name__ and number.isdecimal():
                self.revision = max(self.revision, int(number))
            elif kind == Request.__name__ and number.isdecimal():
                self.met.add(int(number))
            elif kind == MODE and number.isdecimal():
                self.frozen = bool(int(number))
            elif kind == ANOTHER:
                request, _, first = number.partition(" ")
                self._sent.clear()
                self.another, self._file = int(request), self._file_of(int(request))
                self.newest = max(self.newest, int(first) - 1)

    def known(self) -> KnownMap | None:
        """The map as the earlier process saved it last; None: there was none. Raises ValueError for a damaged file, and
        where it is not known what was sent: readers would take two maps for one."""
        if self._lost:
            raise ValueError(
                "the disk was full when this tracker ran before: what it sent is not known, and it cannot go on"
            )
        if not self._file.exists():
            if self._sent:
                raise ValueError("this tracker was killed before it had saved its map, and cannot go on in it")
            if self.another is not None:
                self._stats.warn("the tracker was started again: it begins another map, as was asked for before")
            return None
        known = known_map.load(self._file)
        orphans = self._sent - {keyframe.index for keyframe in known.keyframes}
        self._stats.skip("keyframes that a killed tracker sent after it had saved its map", len(orphans))
        self._stats.warn(
            f"the tracker was started again: it goes on in its map of {len(known.keyframes)} keyframes; {len(orphans)} "
            "that it sent later are mapped and no longer corrected, other frames before have no pose"
        )
        return known

    def note(self, message: Message) -> None:
        """To be called before a message is sent."""
        if isinstance(message, Keyframe):
            self._write(f"{Keyframe.__name__} {message.index}")
            self._changed = True
        elif isinstance(message, Poses):
            self._write(f"{Poses.__name__} {message.revision}")
        elif isinstance(message, Request):
            self._write(f"{Request.__name__} {message.number}")

    def note_mode(self, frozen: bool) -> None:
        self._write(f"{MODE} {int(frozen)}")

    def begin(self, tracker: Tracker, request: int, first: int) -> None:
        """Another map is gone on in, on a request of that number, from this frame on.

        It is saved, or to be saved as soon as it has keyframes, in a file of its own: who returns is in one map or the
        other, whenever this is cut off.
        """
        before, self._file = self._file, self._file_of(request)
        self._changed, self._due = True, 0.0
        self.save(tracker)
        if tracker.mapped and not self._file.exists():
            self._give_up("the map that was begun could not be saved")
        self._write(f"{ANOTHER} {request} {first}")
        before.unlink(missing_ok=True)

    def save(self, tracker: Tracker) -> None:
        """Between two frames, where it is time."""
        if self._lost or not self._changed or not tracker.mapped or self._clock() < self._due:
            return
        began = self._clock()
        try:
            tracker.keep_map(self._file)
        except OSError as error:
            self._stats.warn(f"if this tracker is killed it cannot go on: {error}")
        now = self._clock()
        self._changed, self._due = False, now + (now - began) / SHARE

    def _file_of(self, request: int) -> Path:
        """The map that was begun on it."""
        return self._folder / f"tracker-{request}.npz"

    def _write(self, line: str) -> None:
        """A disk that is full costs the return, not the run. Raises OSError where not even that can be left behind."""
        if self._lost:
            return
        try:
            with self._log.open("a") as log:
                log.write(f"\n{line};")  # begins a line: one that was cut off stays by itself
        except OSError as error:
            self._file.unlink(missing_ok=True)  # it makes room, and is of no use without the log
            self._give_up(str(error))

    def _give_up(self, why: str) -> None:
        """Who returns is told that it cannot go on."""
        self._lost = True
        self._gap.touch()
        self._stats.warn(f"if this tracker is killed it cannot go on: {why}")


__all__ = ["Returning"]
