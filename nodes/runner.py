"""What is the same wherever a node runs, in a process of its own or inline: its hooks called, checked and timed."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from msgs import End, Message
from msgs.codec import MAX_DEPTH, MAX_ITEMS
from nodes import Node, Stats, handlers, outputs

STATS_KEYS = ("counts", "seconds", "skipped", "values", "warnings")


class Runner:
    """A node with its hooks by message type. Raises TypeError when it yields what its annotations do not say."""

    def __init__(self, name: str, node: Node) -> None:
        self.name = name
        self.node = node
        self.busy_seconds = 0.0  # inside the node's own code
        self.sent: Counter[str] = Counter()  # by message type
        self._handlers = handlers(type(node))
        self._outputs = outputs(type(node))

    def handle(self, message: Message) -> Iterator[Message]:
        """What the node makes of one message. End adds the upstream's statistics and yields nothing."""
        if isinstance(message, End):
            merge_stats(self.node.upstream, message.stats)
            return iter(())
        return self._checked(getattr(self.node, self._handlers[type(message)])(message))

    def source(self) -> Iterator[Message]:
        return self._checked(self.node.run())

    def idle(self) -> list[Message] | None:
        """One slice of background work; None when there is nothing to do."""
        start = time.perf_counter()
        produced = self.node.on_idle()
        self.busy_seconds += time.perf_counter() - start
        return None if produced is None else list(self._checked(produced))

    def end(self) -> Iterator[Message]:
        return self._checked(self.node.on_end())

    def _checked(self, produced: Iterable[Message] | None) -> Iterator[Message]:
        messages = iter(produced or ())
        while True:
            start = time.perf_counter()
            message = next(messages, None)
            self.busy_seconds += time.perf_counter() - start
            if message is None:
                return
            if type(message) not in self._outputs:
                allowed = ", ".join(t.__name__ for t in self._outputs) or "nothing"
                raise TypeError(
                    f"{type(self.node).__name__} yields a {type(message).__name__}, but its annotations say {allowed}"
                )
            self.sent[type(message).__name__] += 1
            yield message


def own_stats(node: Node, **figures: Any) -> dict[str, Any]:
    """What the node counted and timed, with the figures of its run, as plain values that a message can carry."""
    return stats_of(node.stats) | {key: plain(value) for key, value in figures.items()}


def stats_of(stats: Stats) -> dict[str, Any]:
    """A copy of the statistics in plain values; safe while the node goes on."""
    return {key: plain(getattr(stats, key).copy()) for key in STATS_KEYS}


def merge_stats(upstream: dict[str, Any], news: Mapping[str, Any]) -> dict[str, Any]:
    """Adds what an End brought, by node name: the paths of a diamond bring the same nodes' figures twice."""
    for name, stats in news.items():
        upstream[name] = plain(stats)
    return upstream


def plain(value: Any, depth: int = MAX_DEPTH - 2) -> Any:
    """Dicts with string keys, lists, numbers, strings, booleans and None, within the codec's limits.

    What does not fit them is replaced by a text that says so: a figure too many must not cost a whole run.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if value is None or isinstance(value, bool | float | str):
        return value
    if isinstance(value, int):
        return int(value) if abs(value) < 2**63 else float(value)
    if isinstance(value, Mapping | list | tuple | set | frozenset):
        if depth == 0 or len(value) > MAX_ITEMS:
            return f"({len(value)} entries left out)"
        if isinstance(value, Mapping):
            return {str(key): plain(item, depth - 1) for key, item in value.items()}
        return [plain(item, depth - 1) for item in value]
    return str(value)
