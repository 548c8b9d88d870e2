"""The same nodes in one process: depth first, so deterministic; no process, no socket. For debuggers and tests."""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import nodes
from launch.graph import Graph
from nodes.parameters import make_config


Observer = Callable[[str, nodes.Node, Any], None]


def run_inline(graph: Graph, observe: Observer | None = None) -> dict[str, nodes.Node]:
    """Runs the graph to its end and returns its nodes by slot, so that a test can look into them.

    Every message goes all the way down before the next one starts, and a node's idle work is done to its end after
    each message. `observe(slot, node, message)` sees every message that a slot sends. An exception in a node passes through.
    """
    _seed(graph.settings.seed)
    return _Inline(graph, observe or (lambda slot, node, message: None)).run()


class _Inline:
    def __init__(self, graph: Graph, observe: Observer) -> None:
        self._graph = graph
        self._observe = observe
        self._nodes = {name: slot.node(make_config(slot.node, slot.config)) for name, slot in graph.slots.items()}
        self._handlers = {name: nodes.handlers(slot.node) for name, slot in graph.slots.items()}

    def run(self) -> dict[str, nodes.Node]:
        sources = {name: self._nodes[name].run() for name in self._graph.sources}
        while sources:  # two sources take turns, as two processes would
            for name, messages in list(sources.items()):
                message = next(messages, None)
                if message is None:
                    del sources[name]
                else:
                    self._send(name, message)
        for name in self._graph.slots:  # senders come before their readers
            self._end(name)
        return self._nodes

    def _send(self, sender: str, message: Any) -> None:
        self._observe(sender, self._nodes[sender], message)
        for edge in self._graph.out_of(sender):
            if edge.message is type(message):
                self._receive(edge.reader, message)

    def _receive(self, name: str, message: Any) -> None:
        node = self._nodes[name]
        self._send_all(name, getattr(node, self._handlers[name][type(message)])(message))
        while (produced := node.on_idle()) is not None:
            self._send_all(name, produced)

    def _send_all(self, name: str, produced: Iterator[Any] | list[Any] | None) -> None:
        for message in produced or ():
            self._send(name, message)

    def _end(self, name: str) -> None:
        node = self._nodes[name]
        for edge in self._graph.into(name):
            sender = self._nodes[edge.sender]
            node.upstream |= sender.upstream | {edge.sender: vars(sender.stats).copy()}
        self._send_all(name, node.on_end())


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)
    importlib.import_module("torch").manual_seed(seed)
