"""What a stage counts, times and warns of, for the live display and the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from mvsgs_core.latency import QUANTILES, Latency
from mvsgs_core.warned import Warnings


@dataclass
class Stats:
    """Figures by name; of a node they travel downstream in `End` and end in the report."""

    counts: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, float] = field(default_factory=dict)  # work that was not done because the scene did not need it
    values: dict[str, Any] = field(default_factory=dict)  # latest value: for the live display and the report
    warnings: Warnings = field(default_factory=Warnings)  # what a user should know: fallbacks, lost tracking
    clock: Callable[[], float] = time.perf_counter  # seconds; time.process_time where other processes disturb
    latencies: dict[str, Latency] = field(default_factory=dict)  # of a live stream, by what was waited for

    def count(self, name: str, n: float = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + n

    def skip(self, what: str, n: float = 1) -> None:
        self.skipped[what] = self.skipped.get(what, 0) + n

    def warn(self, text: str) -> None:
        """The same text is shown once, with a count."""
        self.warnings.add(text)

    def refuse(self, name: str, n: float, text: str) -> None:
        """Counts bad input or a bad step that had no effect, and warns."""
        self.count(f"refused_{name}", n)
        self.warn(text)

    def nothing(self, reason: str) -> None:
        """The stage ends with nothing to show. `reason` is what was measured; the run fails, and says it."""
        self.values["nothing"] = reason

    def arrived(self, what: str, captured: float) -> None:
        """What came from the camera at `captured`, seconds since 1970, is done now; 0: no camera is waited for."""
        if captured > 0.0:
            latency = self.latencies.setdefault(what, Latency())
            latency.add(time.time() - captured)
            self.values["latency"] = self.values.get("latency", {}) | {what: latency.figures}

    def latency(self, *what: str) -> list[list[float]]:
        """[median, 99th percentile] in seconds of each, 0 where nothing arrived yet."""
        found = (self.latencies.get(name, Latency()) for name in what)
        return [[latency.quantile(part) for part in QUANTILES.values()] for latency in found]

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        start = self.clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - start

    def include(self, part: Stats) -> None:
        """The figures of a part as they are now. To be called as often as one likes: nothing is counted twice."""
        self.counts.update(part.counts)
        self.seconds.update(part.seconds)
        self.skipped.update(part.skipped)
        self.values.update(part.values)
        self.warnings.include(part.warnings)

    def add(self, other: Stats) -> None:
        """What another has counted, timed, skipped and warned of, once, beside its own."""
        for own, others in (
            (self.counts, other.counts), (self.seconds, other.seconds), (self.skipped, other.skipped)
        ):  # fmt: skip
            for name, n in others.items():
                own[name] = own.get(name, 0) + n
        for text in other.warnings:
            self.warn(text)


__all__ = ["Stats"]
