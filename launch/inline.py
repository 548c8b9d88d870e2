"""The same nodes in one process: depth first, so deterministic; no process, no socket. For debuggers and tests."""

from __future__ import annotations

import random
import resource
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

import nodes
from launch.graph import Graph
from msgs import End, Message
from nodes.runtime.runner import Runner, end_of

Observer = Callable[[str, nodes.Node, Any], None]


def run_inline(graph: Graph, observe: Observer | None = None) -> dict[str, nodes.Node]:
    """Runs the graph to its end and returns its nodes by slot, so that a test can look into them.

    Every message goes all the way down before the next one starts, and a node's idle work is done to its end after
    each message. `observe(slot, node, message)` sees every message sent. An exception in a node passes through, after
    every node's `on_abort`.
    """
    _seed(graph.settings.seed)
    run = _Inline(graph, observe or (lambda slot, node, message: None))
    try:
        return run.run()
    except BaseException as error:
        run.abort(f"{type(error).__name__}: {error}")
        raise


class _Inline:
    def __init__(self, graph: Graph, observe: Observer) -> None:
        self._graph = graph
        self._observe = observe
        self._runners = {name: Runner(name, slot.node(slot.parameters)) for name, slot in graph.slots.items()}

    def run(self) -> dict[str, nodes.Node]:
        sources: dict[str, Iterator[Message]] = {name: self._runners[name].source() for name in self._graph.sources}
        while sources:  # two sources take turns, as two processes would
            for name, messages in list(sources.items()):
                message = next(messages, None)
                if message is None:
                    del sources[name]
                else:
                    self._send(name, [message])
        for name, runner in self._runners.items():  # senders come before their readers
            self._send(name, runner.end())
            end = self._end(name, runner)
            for reader in dict.fromkeys(edge.reader for edge in self._graph.out_of(name)):
                list(self._runners[reader].handle(end))
        return {name: runner.node for name, runner in self._runners.items()}

    def abort(self, reason: str) -> None:
        """Lets every node save what it has."""
        for runner in self._runners.values():
            runner.node.on_abort(reason)

    def _send(self, sender: str, messages: Iterable[Message]) -> None:
        for message in messages:
            self._observe(sender, self._runners[sender].node, message)
            for edge in self._graph.out_of(sender):
                if edge.message is type(message):
                    self._receive(edge.reader, message)

    def _receive(self, name: str, message: Message) -> None:
        runner = self._runners[name]
        self._send(name, runner.handle(message))
        while (produced := runner.idle()) is not None:
            self._send(name, produced)

    def _end(self, name: str, runner: Runner) -> End:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # of all nodes together, here
        return end_of(name, runner.node, peak_bytes=peak, busy_seconds=runner.busy_seconds)


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(seed)
