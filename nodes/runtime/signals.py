"""What signals ask of a node: SIGINT ends a source's stream, SIGTERM stops any node at its next safe point.

A safe point is between two hooks, at a `yield` of one, and wherever a node waits for others: no state is half changed
there. Who does not reach one in time is killed by the alarm, which needs neither the interpreter nor its lock.
SIGUSR1 writes where all threads stand to the log; it works in a process that hangs in a call, too.
"""

from __future__ import annotations

import faulthandler
import signal

STOP_SECONDS = 3.7  # from SIGTERM to the process's end, wherever it is; its launcher waits a little longer
ABORT_SECONDS = 3.0  # that a node has to save what must not be lost
STARTING = {signal.SIGINT, signal.SIGUSR1}  # a launcher starts a node with these blocked, until it can handle them


class Stopped(Exception):
    """SIGTERM has come."""


class Signals:
    """Remembers what came."""

    def __init__(self) -> None:
        self.interrupted = False
        self._terminated = False

    def install(self) -> None:
        """For the main thread of a process."""
        faulthandler.enable()
        faulthandler.register(signal.SIGUSR1)
        signal.signal(signal.SIGINT, self._interrupt)
        signal.signal(signal.SIGTERM, self._terminate)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, STARTING)

    def check(self) -> None:
        """Raises Stopped once SIGTERM has come: to be called at every safe point."""
        if self._terminated:
            raise Stopped("stopped (SIGTERM)")

    def _interrupt(self, *_: object) -> None:
        self.interrupted = True

    def _terminate(self, *_: object) -> None:
        self._terminated = True
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a second one does not wait
        end_within(STOP_SECONDS)


def end_within(seconds: float) -> None:
    """SIGALRM, whose default is to end the process, after that time; takes an earlier call's place."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
