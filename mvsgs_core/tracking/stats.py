"""What the tracker counts and times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class TrackingStats:
    counts: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)  # work that the scene did not need
    values: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    clock: Callable[[], float] = time.perf_counter  # seconds; time.process_time where other processes disturb

    def count(self, name: str, n: float = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + n

    def skip(self, name: str, n: float = 1) -> None:
        self.skipped[name] = self.skipped.get(name, 0) + n

    def warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        start = self.clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - start


__all__ = ["TrackingStats"]
