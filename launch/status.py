"""What the launcher knows of a running node: it writes one JSON line at a time to a pipe, which is folded in here."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mvsgs_core.printable import printable

TRACEBACK_LINES = 200


@dataclass
class NodeStatus:
    """The newest figures of one node."""

    name: str
    state: str = "starting"  # as the node says it: starting, waiting, running, ending, done, failed, stopped (external)
    progress: int = 0  # steps of its main thread: messages, slices of background work
    doing: str = "starting"  # what that thread is at: working, waiting (for messages), held back (by readers)
    topic: str | None = None  # whose readers hold it back, or did last
    received: Any = field(default_factory=dict)  # messages, by type
    queue: Any = field(default_factory=dict)  # messages that wait, by type
    sent: Any = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    memory: float = 0.0  # resident, bytes
    error: str | None = None
    traceback: str | None = None
    peer: bool = False  # it failed because another node is gone

    def update(self, line: bytes) -> None:
        """Folds one JSON line in, all text made fit for a screen. Raises ValueError for anything else."""
        news = json.loads(line)
        if not isinstance(news, dict):
            raise ValueError(f"{self.name}: a status must be a JSON object, not {line!r}")
        for key, value in news.items():
            name = {"in": "received", "out": "sent", "bytes": "memory"}.get(key, key)
            if name in self.__dataclass_fields__ and name != "name" and value is not None:
                setattr(self, name, printable_lines(value, TRACEBACK_LINES) if name == "traceback" else _shown(value))

    @property
    def done_so_far(self) -> object:
        """Changes whenever the node gets on with its work."""
        return self.state, self.progress, self.doing, repr(self.counts), repr(self.values)


def printable_lines(text: object, most: int) -> str:
    """The last `most` lines of a text, each made fit for a screen."""
    return "\n".join(printable(line) for line in str(text).splitlines()[-most:])


def _shown(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, list):
        return [_shown(item) for item in value]
    if isinstance(value, dict):
        return {printable(key): _shown(item) for key, item in value.items()}
    return value


def total(figure: Any) -> int:
    """Sum of a figure that is a number, or numbers by message type."""
    if isinstance(figure, Mapping):
        return sum(total(item) for item in figure.values())
    return int(figure) if isinstance(figure, int | float) else 0
