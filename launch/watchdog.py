"""Looks after nodes that are no longer heard of, or no longer get on.

Each node's status comes from a thread of its own, so only a process that hangs as a whole, or is stopped, is silent.
One that is heard of but stays at the same piece of work is slow: it is named and left alone, for nobody can tell a long
adjustment from an endless one. Only where it just observes, and holds back a stage that makes the map, is it given up.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

from launch.children import Child
from launch.settings import Supervise
from launch.status import printable_lines

STARTING_SECONDS = 20.0  # more that a node has until it is constructed: libraries are loaded in one call, from a disk
DUMP_SECONDS = 0.5  # that a process has to write where its threads stand
ABSENCE_SECONDS = 2.0  # between two looks: the launcher itself was stopped, or the machine slept
DUMP_LINES = 40


@dataclass
class _Watched:
    child: Child
    slow: bool = False  # has been named
    asked: float | None = None  # when it was asked where its threads stand
    dump_from: int = 0  # bytes of its log before the answer
    named: bool = False
    dump: str = ""


@dataclass
class Watchdog:
    """`look` at the nodes a few times a second; `note` takes what a user should read."""

    limits: Supervise
    note: Callable[[str], None]
    observers: Collection[str] = ()
    clock: Callable[[], float] = time.monotonic
    _watched: dict[str, _Watched] = field(default_factory=dict)
    _looked: float | None = None

    def look(self, children: Iterable[Child]) -> tuple[Child, str] | None:
        """A node to be given up, with the reason; None while all are well, or only slow."""
        now = self.clock()
        running = [child for child in children if child.running]
        self._forgive_own_absence(now, running)
        for child in running:
            watched = self._watched.setdefault(child.name, _Watched(child))
            reason = self._silent(watched, now) or self._held_up(watched, running, now)
            if reason:
                return child, reason
            self._slow(watched, now)
        return None

    def where(self, node: str) -> str:
        """Where that node's threads stood when it was named; empty where that is not known."""
        return self._watched[node].dump if node in self._watched else ""

    def _forgive_own_absence(self, now: float, running: list[Child]) -> None:
        away = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        if away > ABSENCE_SECONDS:
            for child in running:
                child.heard += away
                child.moved += away

    def _silent(self, watched: _Watched, now: float) -> str | None:
        """Names a node that has not been heard of; a reason once that has lasted too long."""
        child, silence = watched.child, now - watched.child.heard
        if child.status.state == "starting" and silence >= self.limits.silent and not child.frozen:
            silence -= STARTING_SECONDS
        if silence < self.limits.silent:
            if watched.named:
                self.note(f"{child.name} is heard of again")
            watched.named, watched.asked = False, None
            return None
        if watched.asked is None:
            watched.asked, watched.dump_from = now, child.log.stat().st_size
            child.send(signal.SIGUSR1)
        if not watched.named and now - watched.asked >= DUMP_SECONDS:
            watched.named = True
            watched.dump = "" if child.frozen else _dump(child, watched.dump_from)
            self.note(f"{child.name} has been silent for {silence:.0f} s: {self._state(watched)}")
        if silence >= max(self.limits.dead, self.limits.silent + DUMP_SECONDS):
            how = "it was stopped by a signal" if child.frozen else "it hangs"
            return f"silent for {silence:.0f} s: {how}"
        return None

    def _state(self, watched: _Watched) -> str:
        limit = f"; after {self.limits.dead:g} s " + (
            "the run goes on without it" if watched.child.name in self.observers else "the run ends"
        )
        if watched.child.frozen:
            return f"its process was stopped (kill -CONT {watched.child.process.pid} lets it go on){limit}"
        if not watched.dump:
            return f"its process hangs{limit}"
        return f"its process hangs{limit}. Where its threads stand:\n{watched.dump}"

    def _held_up(self, watched: _Watched, running: list[Child], now: float) -> str | None:
        """Names an observer that does not get on and holds a stage back; a reason once that has lasted too long."""
        child = watched.child
        if child.name not in self.observers:
            return None
        held = [
            sender
            for sender in running
            if sender.name not in self.observers
            and sender.status.doing == "held back"
            and sender.status.topic in child.status.received
        ]
        seconds = min(now - child.moved, max((now - sender.moved for sender in held), default=0.0))
        if child.status.doing != "working" or seconds < self.limits.silent:
            watched.slow = False
            return None
        what = f"has held {held[0].name} back for {seconds:.0f} s"
        if not watched.slow:
            watched.slow = True
            child.send(signal.SIGUSR1)
            self.note(
                f"{child.name} {what}; after {self.limits.dead:g} s the run goes on without it (where it stands: "
                f"{child.log})"
            )
        return f"it {what}" if seconds >= self.limits.dead else None

    def _slow(self, watched: _Watched, now: float) -> None:
        child = watched.child
        still = now - child.moved
        if child.name in self.observers:
            return
        if still < self.limits.dead or child.status.doing != "working":
            watched.slow = False
        elif not watched.slow and not watched.named:
            watched.slow = True
            child.send(signal.SIGUSR1)
            what = "been at the same piece of work" if child.status.received else "sent nothing"
            self.note(
                f"{child.name} has {what} for {still:.0f} s; it is alive, so it is left alone (where it stands: "
                f"{child.log})"
            )


def _dump(child: Child, start: int) -> str:
    """What the node wrote to its log since it was asked."""
    with child.log.open("rb") as log:
        log.seek(start)
        text = log.read(1 << 16).decode(errors="replace")
    return printable_lines(text, DUMP_LINES)
