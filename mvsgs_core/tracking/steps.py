"""Work in steps of some milliseconds, between which a live tracker finds the poses of the frames that have come.

The steps are the same, in the same order, however much time passes between them: done at once, nothing differs.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeAlias, TypeVar

from mvsgs_core.stats import Stats

T = TypeVar("T")
Steps: TypeAlias = Generator[None, None, T]  # it waits after each step; T: what all of them give


def whole(steps: Steps[T]) -> T:
    """All of it at once."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found: T = end.value
            return found


def timed(stats: Stats, name: str, steps: Steps[T]) -> Steps[T]:
    """The same steps; what they take is timed, and not what is done between them."""
    while True:
        with stats.time(name):
            try:
                next(steps)
            except StopIteration as end:
                found: T = end.value
                return found
        yield


__all__ = ["Steps", "timed", "whole"]
