"""How old things are when they are done, since the camera took them: quantiles in constant memory."""

from __future__ import annotations

import math

import numpy as np

SHORTEST, LONGEST = 1e-4, 1e4  # s: what is beyond counts as these
STEP = 0.02  # by which a bin's upper end is longer than its lower one: a quantile's error is at most half of that
QUANTILES = {"median": 0.5, "p99": 0.99}


class Latency:
    """A histogram of durations, seconds, on a logarithmic scale."""

    def __init__(self) -> None:
        self._counts = np.zeros(1 + _bin(LONGEST), dtype=np.int64)
        self.longest = 0.0

    @property
    def count(self) -> int:
        return int(self._counts.sum())

    def add(self, seconds: float) -> None:
        """One that took so long. A negative one, as of clocks that were set meanwhile, counts as none at all."""
        if not seconds >= 0.0 or not math.isfinite(seconds):
            return
        self._counts[_bin(seconds)] += 1
        self.longest = max(self.longest, seconds)

    def quantile(self, part: float) -> float:
        """The duration, seconds, that this part (0 to 1) of them does not exceed; 0 without any."""
        if not self.count:
            return 0.0
        place = int(np.searchsorted(np.cumsum(self._counts), part * self.count))
        return min(SHORTEST * (1.0 + STEP) ** (place + 0.5), self.longest)

    @property
    def figures(self) -> dict[str, float]:
        """For the report and the live display: seconds, and how many there were."""
        return {name: self.quantile(part) for name, part in QUANTILES.items()} | {"count": self.count}


def _bin(seconds: float) -> int:
    held = min(max(seconds, SHORTEST), LONGEST)
    return int(math.log(held / SHORTEST) / math.log(1.0 + STEP))


__all__ = ["QUANTILES", "Latency"]
