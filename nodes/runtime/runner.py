"""What is the same wherever a node runs, in a process of its own or inline: its hooks called, checked and timed."""

from __future__ import annotations

import random
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from msgs import End, Message
from msgs.codec import MAX_END_HEADER_BYTES, MAX_HEADER_BYTES
from mvsgs_core.stats import Stats
from mvsgs_core.warned import Warnings
from nodes import Node, handlers, outputs
from nodes.runtime.plain import fitted, plain, plain_section

STATS_KEYS = ("counts", "seconds", "skipped", "values", "warnings")
END_BYTES = MAX_END_HEADER_BYTES - MAX_HEADER_BYTES  # the rest is for what a header holds beside the statistics


class Runner:
    """A node with its hooks by message type. Raises TypeError when it yields what its annotations do not say, and of
    one that was not made as a Node is."""

    def __init__(self, name: str, node: Node) -> None:
        if not hasattr(node, "stats"):
            raise TypeError(f"{type(node).__name__}.__init__ must call super().__init__(config), and does not")
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


def seed(number: int) -> None:
    """For all that draws at random, so that the same run can be had again."""
    random.seed(number)
    np.random.seed(number)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(number)


def own_stats(node: Node, **figures: Any) -> dict[str, Any]:
    """What the node counted and timed, with the figures of its run, as plain values that a message can carry."""
    warnings = node.stats.warnings if isinstance(node.stats.warnings, Warnings) else Warnings(node.stats.warnings)
    return stats_of(node.stats) | {"warnings": warnings.lines()} | {key: plain(value) for key, value in figures.items()}


def stats_of(stats: Stats) -> dict[str, Any]:
    """A copy of the statistics in plain values; safe while the node goes on."""
    return {key: plain_section(getattr(stats, key).copy()) for key in STATS_KEYS}


def merge_stats(upstream: dict[str, Any], news: Mapping[str, Any]) -> dict[str, Any]:
    """Adds what an End brought, by node name: the paths of a diamond bring the same nodes' figures twice."""
    for name, stats in news.items():
        upstream[name] = {key: plain(value) for key, value in stats.items()} if isinstance(stats, Mapping) else {}
    return upstream


def end_of(name: str, node: Node, **figures: Any) -> End:
    """The node's last message: its statistics beside those of all nodes upstream, within a message's limits."""
    return End(fitted(merge_stats(dict(node.upstream), {name: own_stats(node, **figures)}), END_BYTES))
