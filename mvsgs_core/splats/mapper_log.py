"""What a mapper counts, times and refuses."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class MapperLog:
    """What was counted, timed and refused, for the report."""

    counts: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def count(self, name: str, n: float = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + n

    def skip(self, what: str, n: float = 1) -> None:
        self.skipped[what] = self.skipped.get(what, 0) + n

    def refuse(self, name: str, n: float, text: str) -> None:
        """Counts bad input or a bad step that did not reach the map, and warns once."""
        self.count(f"refused_{name}", n)
        if text not in self.warnings:
            self.warnings.append(text)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
