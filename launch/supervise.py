"""Runs a graph as processes: starts them, watches them, stops them, and leaves nothing behind.

First Ctrl-C: only the sources end, so that the map and the report are finished. Second, or before all nodes are
started: everything stops. A stage that fails stops the graph, in an orderly way: every node may save what it has. Who
only observes fails alone. SIGTERM and a closed terminal stop everything.
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import psutil

from launch.children import Child, python_environment
from launch.graph import Graph
from launch.outcome import BY_SIGNAL, FAILED, Failure, Outcome, finished
from launch.placement import own_threads, thread_environment, thread_plan
from launch.run_directory import RunDirectory, remove_orphans
from launch.screen import Screen
from launch.specs import addresses, new_token, spec, write_spec
from launch.status import NodeStatus
from launch.watchdog import Watchdog

TERMINATE_SECONDS = 4.0  # from the first sign of a failure, or a second Ctrl-C, to SIGKILL
REFRESH_SECONDS = 0.25
BLAME_SECONDS = 1.5  # how long to listen, after a node failed for want of a neighbor, for what befell that one


class Supervisor:
    """One run of a graph."""

    def __init__(self, graph: Graph, screen: Screen, over: Callable[[Outcome], None] = lambda outcome: None) -> None:
        """over: called as soon as the run has ended for all but those who only stay open, such as a viewer's page."""
        self._graph = graph
        self._over = over
        self._ended: Outcome | None = None  # what it was called with
        self._screen = screen
        self._children: dict[str, Child] = {}
        self._waker, self._wakeup = socket.socketpair()
        self._signals: list[int] = []
        self._interrupts = 0
        self._started = False  # all nodes that are started here
        self._selector = selectors.DefaultSelector()
        self._watchdog = Watchdog(graph.settings.supervise, screen.note, graph.observers)
        self._failed_observers: dict[str, Failure] = {}
        self._stop_by: float | None = None  # when what is left is killed

    def run(self) -> Outcome:
        """Runs to the end. Whatever happens, no process, socket file or temporary directory is left."""
        try:
            with self._signal_handlers():
                for orphan in remove_orphans():
                    self._screen.note(f"removed {orphan}: its launcher was killed")
                directory = RunDirectory(self._graph)
                try:
                    self._start(directory)
                    return self._watch(directory)
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
        address, token = addresses(self._graph, directory.path), new_token(self._graph)
        statuses = {name: NodeStatus(name) for name in self._graph.slots}
        processes: dict[str, psutil.Process] = {}
        self._screen.start(self._graph, statuses, processes)
        for name, slot in self._graph.slots.items():
            path = directory.path / f"{name}.json"
            if slot.placement.external:
                write_spec(spec(self._graph, name, address, own_threads(slot), None, token), path)
                statuses[name].state = "external"
                command = shlex.join([sys.executable, "-m", "nodes", str(path)])
                environment = " ".join(f"{key}={shlex.quote(value)}" for key, value in python_environment().items())
                self._screen.note(f"{name} is external: run it with\n  {environment} {command}")
                continue
            if self._signals:
                return  # stopped while starting: _watch acts on it
            pipe = os.pipe()
            write_spec(spec(self._graph, name, address, plan[name], pipe[1], token), path)
            child = Child(statuses[name], path, pipe, logs / f"{name}.log", thread_environment(plan[name]))
            self._children[name] = child
            self._selector.register(child.pipe, selectors.EVENT_READ, child)
            processes[name] = psutil.Process(child.process.pid)
        self._started = True

    def _watch(self, directory: RunDirectory) -> Outcome:
        """Until every process has ended by itself, a stage has failed, or a signal says to stop."""
        while True:
            self._listen(REFRESH_SECONDS)
            while self._signals:  # first: whoever stops a service tells its nodes, too
                number = self._signals.pop(0)
                if self._ended is not None:
                    self._stop_by = time.monotonic()  # there is nothing left to save
                    return self._ended
                if number != signal.SIGINT:
                    return self._stopped(number)
                self._interrupts += 1
                if self._interrupts > 1 or not self._started:  # a source would wait for readers that never come
                    return self._stopped(number)
                self._end_sources()
            if any(child.failure() for child in self._stages()):
                return self._blame()
            watched = [child for name, child in self._children.items() if name not in self._failed_observers]
            if given_up := self._watchdog.look(watched):
                child, reason = given_up
                failure = Failure(child.name, reason, self._watchdog.where(child.name), child.log)
                if child.name not in self._graph.observers:
                    return self._failure(failure)
                self._give_up(child, failure, directory)
            failed = [child for child in self._observers() if child.failure()]
            for child in failed:
                # one that has only lost its sender is heard before it is known that this one has failed
                if not child.status.peer or time.monotonic() - child.heard > BLAME_SECONDS:
                    self._give_up(child, child.failed(), directory)
            if not failed and not any(child.running for child in self._children.values()):
                return self._finished()
            self._screen.refresh()
            if self._ended is None and (kept := self._kept_open()):
                self._ended = self._finished()
                self._over(self._ended)
                for status in kept:
                    where = f" at {status.values['url']}" if "url" in status.values else ""
                    self._screen.note(f"{status.name} stays open{where}: close it there, or press Ctrl-C")

    def _stages(self) -> list[Child]:
        """The nodes that make the map."""
        return [child for name, child in self._children.items() if name not in self._graph.observers]

    def _observers(self) -> list[Child]:
        """The nodes that only observe, without those that were given up."""
        there = [child for name, child in self._children.items() if name in self._graph.observers]
        return [child for child in there if child.name not in self._failed_observers]

    def _kept_open(self) -> list[NodeStatus]:
        """The nodes that wait for their user to close them, once all others have ended well."""
        running = [child for child in self._children.values() if child.running]
        failed = any(child.failure() for child in (*self._stages(), *self._observers()))
        waiting = all(child.status.values.get("kept_open") is True for child in running)
        return [child.status for child in running] if waiting and not failed else []

    def _give_up(self, child: Child, failure: Failure, directory: RunDirectory) -> None:
        """The run goes on without this observer."""
        self._failed_observers[child.name] = failure
        child.kill_group()
        child.wait(1.0)
        directory.tell_gone(child.name)
        self._screen.note(f"{child.name} failed: {failure.error}; the run goes on without it (log: {child.log})")

    def _finished(self) -> Outcome:
        for child in self._children.values():
            with suppress(ValueError, OSError):
                child.read_status()
        cut_off, nothing = self._said("cut_off"), self._said("nothing")
        # where there is nothing to show, the footage is not all that there is to blame
        ended = finished(tuple(self._failed_observers.values()), cut_off | nothing if nothing else {}, cut_off)
        if not (unseen := self._unseen()):
            return ended
        reason = "; ".join(f"{name} is external: its end is not known here" for name in unseen)
        return replace(ended, code=ended.code if nothing else FAILED, reason=reason, unseen=unseen)

    def _unseen(self) -> tuple[str, ...]:
        """The external stages that no node here has heard to the end, itself or by others."""
        slots, sources = self._graph.slots, self._graph.sources
        heard = {name for name in self._children if name not in self._failed_observers}
        for name in reversed(slots):  # readers come after their senders
            if any(edge.reader in heard and edge.reader not in sources for edge in self._graph.out_of(name)):
                heard.add(name)
        return tuple(name for name in slots if name not in heard and name not in self._graph.observers)

    def _said(self, key: str) -> dict[str, str]:
        """A value that is text, by node, of those that have it, in the graph's order."""
        statuses = {name: self._children[name].status for name in self._graph.slots if name in self._children}
        return {name: str(status.values[key]) for name, status in statuses.items() if status.values.get(key)}

    def _stopped(self, number: int) -> Outcome:
        self._stop_by = time.monotonic() + TERMINATE_SECONDS
        how = "stopped by Ctrl-C" if number == signal.SIGINT else f"stopped by {signal.Signals(number).name}"
        return Outcome(BY_SIGNAL + number, how, observers=tuple(self._failed_observers.values()))

    def _failure(self, failure: Failure) -> Outcome:
        self._stop_by = self._stop_by or time.monotonic() + TERMINATE_SECONDS
        reason = f"{failure.node} failed: {failure.error}"
        return Outcome(FAILED, reason, failure, tuple(self._failed_observers.values()))

    def _listen(self, seconds: float) -> None:
        for key, _ in self._selector.select(seconds):
            if key.data is None:
                with suppress(BlockingIOError):
                    self._waker.recv(64)
            elif not key.data.read_status():
                self._selector.unregister(key.fileobj)
                key.data.wait(1.0)  # its pipe is closed: it is going

    def _end_sources(self) -> None:
        elsewhere = [name for name in self._graph.sources if name not in self._children]
        if elsewhere != self._graph.sources:
            what = "the stream ends here; the map and the report are being finished"
            self._screen.note(f"Ctrl-C: {what} (again: stop now)")
        for name in elsewhere:
            self._screen.note(f"{name} is external: end it where it runs (Ctrl-C there); Ctrl-C again here: stop now")
        for name in self._graph.sources:
            if name in self._children:
                self._children[name].send(signal.SIGINT)

    def _blame(self) -> Outcome:
        """The failure that came first. One node's death makes its neighbors fail, and they may be heard before it."""
        self._stop_by = time.monotonic() + TERMINATE_SECONDS
        until = time.monotonic() + BLAME_SECONDS
        while (left := until - time.monotonic()) > 0:
            self._listen(left)
            if any(child.failure() and not child.status.peer for child in self._stages()):
                break
        failed = [child for child in self._stages() if child.failure()]
        child = min(failed, key=lambda child: (child.status.peer, (child.code or 0) >= 0))
        child.read_status()
        return self._failure(child.failed())

    def _stop_all(self) -> None:
        """SIGTERM, SIGKILL for what is left when the time is over; then no process of the run is alive."""
        running = [child for child in self._children.values() if child.running]
        for child in running:
            child.send(signal.SIGTERM)
        until = self._stop_by or time.monotonic() + TERMINATE_SECONDS
        while any(child.running and not child.frozen for child in running) and time.monotonic() < until:
            self._listen(0.05)
        for child in self._children.values():
            child.kill_group()
            child.wait()
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
