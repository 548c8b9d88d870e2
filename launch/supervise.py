"""Runs a graph as processes: starts them, watches them, stops them, and leaves nothing behind.

First Ctrl-C: only the sources end, so that the map and the report are finished. Second: everything stops. A node that
fails stops the graph. SIGTERM and a closed terminal stop everything at once.
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import psutil

from launch.children import Child, python_path
from launch.graph import Graph
from launch.placement import thread_environment, thread_plan
from launch.screen import Screen
from launch.specs import RunDirectory, addresses, spec, write_spec
from launch.status import NodeStatus

TERMINATE_SECONDS = 3.0  # from SIGTERM to SIGKILL
REFRESH_SECONDS = 0.25
BLAME_SECONDS = 1.5  # how long to listen, after a node failed for want of a neighbor, for what befell that one


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    code: int  # for the shell: 0, 1 after a failure, 130 after a second Ctrl-C, 143 after SIGTERM
    failed: str | None = None  # node
    error: str = ""
    traceback: str = ""
    log: Path | None = None
    interrupted: bool = False  # the stream was ended early, by Ctrl-C


class Supervisor:
    """One run of a graph."""

    def __init__(self, graph: Graph, screen: Screen) -> None:
        self._graph = graph
        self._screen = screen
        self._children: dict[str, Child] = {}
        self._waker, self._wakeup = socket.socketpair()
        self._signals: list[int] = []
        self._interrupts = 0
        self._selector = selectors.DefaultSelector()

    def run(self) -> Outcome:
        """Runs to the end. Whatever happens, no process, socket file or temporary directory is left."""
        try:
            with self._signal_handlers():
                directory = RunDirectory.create(self._graph)
                try:
                    self._start(directory)
                    return self._watch()
                finally:
                    try:
                        self._stop_all()
                    finally:
                        directory.remove()
        finally:
            self._close()

    def _start(self, directory: RunDirectory) -> None:
        logs = Path(self._graph.settings.output) / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        plan = thread_plan(self._graph)
        address = addresses(self._graph, directory.path)
        statuses = {name: NodeStatus(name) for name in self._graph.slots}
        processes: dict[str, psutil.Process] = {}
        self._screen.start(self._graph, statuses, processes)
        for name, slot in self._graph.slots.items():
            path = directory.path / f"{name}.json"
            if slot.placement.external:
                write_spec(spec(self._graph, name, address, plan[name], None), path)
                statuses[name].state = "external"
                command = shlex.join([sys.executable, "-m", "nodes", str(path)])
                self._screen.note(f"{name} is external: run it with\n  PYTHONPATH={python_path()} {command}")
                continue
            if self._signals:
                return  # stopped while starting: _watch acts on it
            pipe = os.pipe()
            write_spec(spec(self._graph, name, address, plan[name], pipe[1]), path)
            child = Child(statuses[name], path, pipe, logs / f"{name}.log", thread_environment(plan[name]))
            self._children[name] = child
            self._selector.register(child.pipe, selectors.EVENT_READ, child)
            processes[name] = psutil.Process(child.process.pid)

    def _watch(self) -> Outcome:
        """Until every process has ended by itself, one has failed, or a signal says to stop."""
        while True:
            self._listen(REFRESH_SECONDS)
            if any(child.failure() for child in self._children.values()):
                return self._blame()
            while self._signals:
                number = self._signals.pop(0)
                if number != signal.SIGINT:
                    return Outcome(128 + number, interrupted=True)
                self._interrupts += 1
                if self._interrupts > 1:
                    return Outcome(130, interrupted=True)
                self._end_sources()
            if all(child.process.poll() is not None for child in self._children.values()):
                return Outcome(0, interrupted=self._interrupts > 0)
            self._screen.refresh()

    def _listen(self, seconds: float) -> None:
        for key, _ in self._selector.select(seconds):
            if key.data is None:
                with suppress(BlockingIOError):
                    self._waker.recv(64)
            elif not key.data.read_status():
                self._selector.unregister(key.fileobj)
                with suppress(Exception):
                    key.data.process.wait(1.0)  # its pipe is closed: it is going

    def _end_sources(self) -> None:
        self._screen.note("Ctrl-C: the stream ends here; the map and the report are being finished (again: stop now)")
        for name in self._graph.sources:
            if name in self._children:
                self._children[name].send(signal.SIGINT)

    def _blame(self) -> Outcome:
        """The failure that came first. One node's death makes its neighbors fail, and they may be heard before it."""
        until = time.monotonic() + BLAME_SECONDS
        while (left := until - time.monotonic()) > 0:
            self._listen(left)
            if any(child.failure() and not child.status.peer for child in self._children.values()):
                break
        failed = [child for child in self._children.values() if child.failure()]
        child = min(failed, key=lambda child: (child.status.peer, (child.process.poll() or 0) >= 0))
        child.read_status()
        return Outcome(1, child.name, child.failure() or "", child.last_words(), child.log)

    def _stop_all(self) -> None:
        """SIGTERM, SIGKILL for what is left after TERMINATE_SECONDS; then no process of the run is alive."""
        running = [child for child in self._children.values() if child.process.poll() is None]
        for child in running:
            child.send(signal.SIGTERM)
        until = time.monotonic() + TERMINATE_SECONDS
        for child in running:
            with suppress(Exception):
                child.process.wait(max(0.0, until - time.monotonic()))
        for child in self._children.values():
            child.kill_group()
            child.process.wait()
        for child in self._children.values():
            with suppress(ValueError, OSError):
                child.read_status()
        self._screen.refresh()
        self._screen.stop()

    def _close(self) -> None:
        self._selector.close()
        for child in self._children.values():
            child.close()
        self._waker.close()
        self._wakeup.close()

    @contextmanager
    def _signal_handlers(self) -> Iterator[None]:
        """Collects signals, and wakes the loop for them, instead of raising exceptions at any point of it."""
        self._waker.setblocking(False)
        self._wakeup.setblocking(False)
        self._selector.register(self._waker, selectors.EVENT_READ, None)

        def collect(number: int, frame: FrameType | None) -> None:
            self._signals.append(number)

        previous: dict[signal.Signals, Any] = {}
        wakeup = signal.set_wakeup_fd(self._wakeup.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup: outlive the terminal
                previous[number] = signal.signal(number, collect)
        try:
            yield
        finally:
            for stopped_by, handler in previous.items():
                signal.signal(stopped_by, handler)
            signal.set_wakeup_fd(wakeup)
