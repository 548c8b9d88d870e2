"""What signals ask of a node: SIGINT ends a source's stream, SIGTERM stops any node at its next safe point.

A second SIGINT stops a node that was started by hand, as Ctrl-C does twice in its terminal; a second SIGTERM changes
nothing, for a launcher and whoever stops it may both send one while the node saves what it has.
A safe point is between two hooks, at a `yield` of one, and wherever a node waits for others: no state is half changed
there. Who does not reach one in time is killed by the alarm, which needs neither the interpreter nor its lock.
SIGUSR1 writes where all threads stand to the log; it works in a process that hangs in a call, too.
"""

from __future__ import annotations

import faulthandler
import signal
import time

STOP_SECONDS = 3.7  # from the signal that stops a process to its end, wherever it is; its launcher waits longer
ABORT_SECONDS = 3.0  # that a node has to save what must not be lost
TOLD_SECONDS = 0.5  # between the first and the last process of a graph, where all are told to stop one by one
STARTING = {signal.SIGINT, signal.SIGUSR1}  # a launcher starts a node with these blocked, until it can handle them


class Stopped(Exception):
    """A signal that stops the node has come: its number."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped ({signal.Signals(number).name})")
        self.number = number


class Signals:
    """Remembers what came."""

    def __init__(self) -> None:
        self.interrupted = False
        self.by_hand = False  # nobody but its terminal's user can stop this node
        self._stopped_by: int | None = None

    def install(self) -> None:
        """For the main thread of a process."""
        faulthandler.enable()
        faulthandler.register(signal.SIGUSR1)
        signal.signal(signal.SIGINT, self._interrupt)
        signal.signal(signal.SIGTERM, self._stop)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STARTING)

    def check(self) -> None:
        """Raises Stopped once the node is to stop: to be called at every safe point."""
        if self._stopped_by is not None:
            raise Stopped(self._stopped_by)

    def check_soon(self) -> None:
        """For a node that has lost another one, which may be the first of all to be told to stop: raises Stopped if a
        signal comes within TOLD_SECONDS."""
        until = time.monotonic() + TOLD_SECONDS
        while time.monotonic() < until:
            self.check()
            time.sleep(0.01)

    def _interrupt(self, number: int, frame: object) -> None:
        if self.interrupted and self.by_hand:
            self._stop(number, frame)
        self.interrupted = True

    def _stop(self, number: int, frame: object) -> None:
        if self._stopped_by is None:  # a repeated one gives no more time either
            self._stopped_by = number
            end_within(STOP_SECONDS)


def end_within(seconds: float) -> None:
    """SIGALRM, whose default is to end the process, after that time; takes an earlier call's place."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
