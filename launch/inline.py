"""The same nodes in one process: depth first, so deterministic; no process, no socket.

For debuggers, for tests, and for programs that map by themselves (mvsgs/mapping.py).
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import nodes
from launch.graph import Graph, Slot
from msgs import End, Message
from msgs.codec import CodecError, check
from nodes.runtime.requests import Pause
from nodes.runtime.runner import Runner, end_of, exit_fails, seed

POLL = 0.05  # s between two looks at what is asked, while the stream waits
Observer = Callable[[str, nodes.Node, Any], None]


def run_inline(graph: Graph, observe: Observer | None = None) -> dict[str, nodes.Node]:
    """Runs the graph to its end and returns its nodes by slot, so that a test can look into them.

    Every message goes all the way down before the next one starts, and a node's idle work is done to its end after
    each message. `observe(slot, node, message)` sees every message sent. An exception in a node passes through, after
    every node's `on_abort`. Raises CodecError for a message that differs from its annotations, as a process would.
    """
    seed(graph.settings.seed)
    run = InlineGraph(graph, observe)
    try:
        run.run_sources()
        run.end()
    except BaseException as error:
        run.abort(f"{type(error).__name__}: {error}")
        raise
    return run.nodes


class InlineGraph:
    """A graph whose nodes were made, and wait: `run_sources` as often as a source has something new, then `end`."""

    def __init__(self, graph: Graph, observe: Observer | None = None) -> None:
        """observe(slot, node, message) sees every message sent."""
        self._graph = graph
        self._observe = observe or (lambda slot, node, message: None)
        self._runners = {name: _runner(slot) for name, slot in graph.slots.items()}
        self._pauses = {name: Pause(self._runners[name].node) for name in graph.sources}
        self._asked: dict[str, list[Any]] = {}  # of each source, on its way there

    @property
    def nodes(self) -> dict[str, nodes.Node]:
        """By slot."""
        return {name: runner.node for name, runner in self._runners.items()}

    def run_sources(self) -> None:
        """Takes what the sources have and does all that comes of it."""
        sources: dict[str, Iterator[Message]] = {name: self._runners[name].source() for name in self._graph.sources}
        while sources:  # two sources take turns, as two processes would
            for name, messages in list(sources.items()):
                pause = self._pauses[name]
                self._ask(name, pause)
                if pause.waits:
                    time.sleep(POLL)
                    continue
                message = next(messages, None)
                if message is None:
                    del sources[name]
                elif not pause.leaves_out(message):
                    self._send(name, [message])

    def end(self) -> None:
        """The stream is over: every node finishes its work."""
        for name, runner in self._runners.items():  # senders come before their readers
            self._send(name, runner.end())
            end = self._end(name, runner)
            for reader in dict.fromkeys(e.reader for e in self._graph.out_of(name) if e.reader not in self._pauses):
                list(self._runners[reader].handle(end))

    def abort(self, reason: str) -> None:
        """Lets every node save what it has."""
        for runner in self._runners.values():
            runner.abort(reason)

    def _ask(self, source: str, pause: Pause) -> None:
        """What came for a source since its last message goes out, and who asks may ask for more."""
        for asking in {edge.sender for edge in self._graph.into(source)}:
            self._send(asking, self._runners[asking].idle() or ())
        for request in self._asked.pop(source, []):
            pause.note(request)
            self._send(source, [request])

    def _send(self, sender: str, messages: Iterable[Message]) -> None:
        for message in messages:
            _check(sender, message)
            self._observe(sender, self._runners[sender].node, message)
            for edge in self._graph.out_of(sender):
                if edge.message is type(message) and edge.reader in self._pauses:  # in its place among the frames
                    self._asked.setdefault(edge.reader, []).append(message)
                elif edge.message is type(message):
                    self._receive(edge.reader, message)

    def _receive(self, name: str, message: Message) -> None:
        runner = self._runners[name]
        self._send(name, runner.handle(message))
        while (produced := runner.idle()) is not None:
            self._send(name, produced)

    def _end(self, name: str, runner: Runner) -> End:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # of all nodes together, here
        return end_of(name, runner.node, peak_bytes=peak, busy_seconds=runner.busy_seconds)


def _runner(slot: Slot) -> Runner:
    with exit_fails(slot.name):
        node = slot.node(slot.parameters)
    return Runner(slot.name, node)


def _check(sender: str, message: Message) -> None:
    """Raises CodecError, with the sender, for a message that no process could send."""
    try:
        check(message)
    except CodecError as error:
        raise CodecError(f"{sender}: {error}") from error
