"""How much effort the next keyframe gets, so that a stage never falls behind the camera for long.

A stage that keeps a live camera's pace has a few ways to do its work, from the best to the quickest, which it prices
by what the work has cost here so far. Of these it takes the best by which what waits is done within `HORIZON`, beside
all that comes meanwhile. So it saves where much is to be done, on a slow or busy machine too, and gives back where
little is. Where it has time for none of them on any keyframe, it makes the quickest on as many as there is time for.
It knows what waits for it and nothing of other stages: no message tells it what to do, and none can be lost.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from mvsgs_core.stats import Stats

HORIZON = 1.0  # s in which a stage works off what waits
GAPS = 8  # keyframes over which their rate is taken
MEMORY = 0.3  # weight of the newest cost
FORGETTING = 0.95  # of the cost, at a keyframe that says nothing of it: the machine may be free again


@dataclass(frozen=True)
class Effort:
    """A way to do the work."""

    name: str
    cost: float  # of the first and best one, about
    telling: bool = True  # the time it takes says what the others would


def check_share(share: float) -> None:
    """Raises ValueError for what is no share."""
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share={share}: of a core's time, above 0 and at most 1")


def check_efforts(efforts: Sequence[Effort], only: Sequence[int] | None) -> None:
    """Raises ValueError for positions that none of the efforts has, and for none at all; None: all."""
    if only is not None and not (only and set(only) <= set(range(len(efforts)))):
        names = ", ".join(f"{k}: {effort.name}" for k, effort in enumerate(efforts))
        raise ValueError(f"efforts={list(only)}: some of {names}")


class Pace:
    """Feeds on keyframes as they come (`came`), and on what they cost (`spend`)."""

    def __init__(
        self, efforts: Sequence[Effort], share: float, log: Stats | None = None, only: Sequence[int] | None = None
    ) -> None:
        """efforts: best first. share: of the time, that the stage may work: the rest of a core is others'.

        only: positions of the efforts that may be made; None: all. Raises ValueError for none, or others.
        """
        self.efforts, self.share = tuple(efforts), share
        check_efforts(self.efforts, only)
        self._open = sorted(range(len(self.efforts)) if only is None else set(only))
        check_share(share)
        self.log = Stats() if log is None else log
        self.waiting: Callable[[], int] = lambda: 0  # keyframes that came and were not taken up
        self._gaps: deque[float] = deque(maxlen=GAPS)  # seconds of the stream between two keyframes
        self._newest: float | None = None  # timestamp
        self._saved = 0.0  # seconds that keyframes could have cost, since the last on which there was work
        self._cost: float | None = None  # seconds of the best effort; None: not known yet

    @property
    def interval(self) -> float:
        """Seconds of the stream from one keyframe to the next, lately. A pause of the camera is none of them."""
        return float(np.median(self._gaps)) if self._gaps else HORIZON

    @property
    def allowed(self) -> float:
        """Seconds that a keyframe may cost now."""
        coming = HORIZON / (self.share * max(self.interval, 1e-6))
        return HORIZON / (self.waiting() + coming)

    @property
    def fits(self) -> bool:
        """Whether the best effort is done, about, before the next keyframe comes."""
        return self._cost is not None and self._cost * self.efforts[0].cost <= self.interval

    def came(self, timestamp: float) -> None:
        """A keyframe of this time in the stream, seconds, is to be worked on."""
        if not math.isfinite(timestamp):
            return
        if self._newest is not None and timestamp > self._newest:
            self._gaps.append(timestamp - self._newest)
        self._newest = timestamp

    def choose(self) -> int:
        """The effort for the next keyframe: a position in `efforts`."""
        if self._cost is None:  # the second best that tells it is good, and no disaster where it takes long
            telling = [k for k in self._open if self.efforts[k].telling]
            return telling[:2][-1] if telling else self._open[-1]
        allowed, cost = self.allowed, self._cost
        chosen = next((k for k in self._open if self.efforts[k].cost * cost <= allowed), self._open[-1])
        if (
            not self.efforts[chosen].telling and not self.waiting()
        ):  # no work at all: what that saved may do for the quickest that is some
            quickest = [k for k in self._open if self.efforts[k].telling][-1:]
            chosen = next((k for k in quickest if self.efforts[k].cost * cost <= allowed + self._saved), chosen)
        return chosen

    @contextmanager
    def spend(self) -> Iterator[int]:
        """The effort to work with in this context, whose time is what it costs."""
        chosen, start = self.choose(), self.log.clock()
        yield chosen
        self.spent(chosen, self.log.clock() - start)

    def spent(self, chosen: int, seconds: float) -> None:
        """So long that effort took."""
        effort = self.efforts[chosen]
        self._saved = 0.0 if effort.telling else self._saved + max(0.0, self.allowed - seconds)
        if effort.telling:
            found = seconds / effort.cost
            self._cost = found if self._cost is None else (1.0 - MEMORY) * self._cost + MEMORY * found
        elif self._cost is not None:
            self._cost *= FORGETTING
        if chosen:
            self.log.skip(f"effort on keyframes: {effort.name}")


__all__ = ["HORIZON", "Effort", "Pace", "check_efforts", "check_share"]
