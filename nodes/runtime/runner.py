"""What is the same wherever a node runs, in a process of its own or inline: its hooks called, checked and timed."""

from __future__ import annotations

import logging
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from msgs import End, Frame, Message
from msgs.codec import MAX_END_HEADER_BYTES, MAX_HEADER_BYTES
from mvsgs_core.stats import Stats
from mvsgs_core.warned import Warnings
from nodes import Node, handlers, outputs
from nodes.runtime.plain import fitted, plain, plain_section

STATS_KEYS = ("counts", "seconds", "skipped", "values", "warnings")
END_BYTES = MAX_END_HEADER_BYTES - MAX_HEADER_BYTES  # the rest is for what a header holds beside the statistics


class Runner:
    """A node with its hooks by message type.

    Raises TypeError when it yields what its annotations do not say, and of one that was not made as a Node is,
    ValueError of a source whose frames are not numbered upward, and RuntimeError where a hook calls sys.exit.
    """

    def __init__(self, name: str, node: Node) -> None:
        if not hasattr(node, "stats"):
            raise TypeError(f"{type(node).__name__}.__init__ must call super().__init__(config), and does not")
        self.name = name
        self.node = node
        self.busy_seconds = 0.0  # inside the node's own code
        self.sent: Counter[str] = Counter()  # by message type
        self._handlers = handlers(type(node))
        self._outputs = outputs(type(node))
        self._last_frame: int | None = None  # index of the newest that a source has yielded

    def handle(self, message: Message) -> Iterator[Message]:
        """What the node makes of one message. End adds the upstream's statistics and yields nothing."""
        if isinstance(message, End):
            merge_stats(self.node.upstream, message.stats)
            return iter(())
        return self._checked(self._call(getattr(self.node, self._handlers[type(message)]), message))

    def source(self) -> Iterator[Message]:
        for message in self._checked(self._call(self.node.run)):
            if isinstance(message, Frame):
                self._check_order(message)
            yield message

    def idle(self) -> list[Message] | None:
        """One slice of background work; None when there is nothing to do."""
        start = time.perf_counter()
        produced = self._call(self.node.on_idle)
        self.busy_seconds += time.perf_counter() - start
        return None if produced is None else list(self._checked(produced))

    def end(self) -> Iterator[Message]:
        return self._checked(self._call(self.node.on_end))

    def abort(self, reason: str) -> None:
        """Lets the node save what it has. Where it cannot, the log says why: the run has failed of something else."""
        try:
            self._call(self.node.on_abort, reason)
        except Exception:
            logging.exception("%s: on_abort failed", self.name)

    def _check_order(self, frame: Frame) -> None:
        if self._last_frame is not None and frame.index <= self._last_frame:
            raise ValueError(
                f"{type(self.node).__name__} yields Frame {frame.index} after Frame {self._last_frame}: a source's "
                "frames are numbered upward, as in 0, 1, 2"
            )
        self._last_frame = frame.index

    def _call(self, hook: Callable[..., Any], *given: Any) -> Any:
        with exit_fails(self.name):
            return hook(*given)

    def _checked(self, produced: Iterable[Message] | None) -> Iterator[Message]:
        if not isinstance(produced or (), Iterable):
            raise TypeError(
                f"{type(self.node).__name__} returns a {type(produced).__name__}: a node yields its messages, "
                "or returns a list of them"
            )
        messages = iter(produced or ())
        while True:
            start = time.perf_counter()
            message = self._call(next, messages, None)
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


@contextmanager
def exit_fails(name: str) -> Iterator[None]:
    """Around a node's own code, of the slot `name`. Raises RuntimeError where it calls sys.exit: a failure as any."""
    try:
        yield
    except SystemExit as error:
        said = "" if error.code is None else repr(error.code)
        raise RuntimeError(f"{name} called sys.exit({said}): a node that cannot go on raises an error") from error


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
