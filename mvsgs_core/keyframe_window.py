"""The newest keyframes of a stream: each is handed out once, `lag` keyframes late, with those around it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np


class Correction(NamedTuple):
    """What the tracker knows better of a keyframe that it sent."""

    world_from_cam: np.ndarray  # (4, 4)
    scale: float  # of the map
    segment: int | None = None  # that it belongs to now; None: as it was


class WindowedKeyframe(Protocol):
    """What the window asks of a keyframe."""

    @property
    def index(self) -> int: ...

    @property
    def segment(self) -> int: ...

    @property
    def size(self) -> tuple[int, int]:
        """(height, width): keyframes of different sizes are not compared."""

    @property
    def world_from_cam(self) -> np.ndarray: ...

    @property
    def scale(self) -> float: ...

    def moved(self, world_from_cam: np.ndarray, scale: float, segment: int | None = None) -> Self:
        """The same keyframe after a `Correction`."""


K = TypeVar("K", bound=WindowedKeyframe)
R = TypeVar("R")  # what a stage makes of a keyframe


class KeyframeWindow(Generic[K]):
    """Takes keyframes in stream order; `add` and `flush` yield each wanted one exactly once, in order, with its others:

    the one before it, up to `before` more, and `lag` after it. A new segment or size starts a new window.
    """

    def __init__(self, before: int, lag: int) -> None:
        self._before, self._lag = before, lag
        self._keyframes: list[K] = []  # oldest first
        self._waiting: list[int] = []  # indices of those not handed out yet, oldest first

    def add(self, keyframe: K, wanted: bool = True) -> Iterator[tuple[K, list[K]]]:
        """Yields the keyframe `lag` before this one; all that wait if this one starts a new window.

        wanted: whether this one is to be handed out too; else it is one of the others only.
        """
        last = self._keyframes[-1] if self._keyframes else keyframe
        if (keyframe.segment, keyframe.size) != (last.segment, last.size):
            yield from self.flush()
            self._keyframes.clear()
        self._keyframes.append(keyframe)
        if wanted:
            self._waiting.append(keyframe.index)
        while len(self._waiting) > self._lag:
            yield self._next()
        del self._keyframes[: max(0, len(self._keyframes) - self._before - self._lag - 1)]

    def release(self) -> Iterator[tuple[K, list[K]]]:
        """Yields the keyframe that has waited longest, if any, with the others that are there."""
        if self._waiting:
            yield self._next()

    @property
    def waiting(self) -> int | None:
        """Index of the keyframe that has waited longest."""
        return self._waiting[0] if self._waiting else None

    def flush(self) -> Iterator[tuple[K, list[K]]]:
        """Yields the keyframes that still wait, with the others that are there."""
        while self._waiting:
            yield self._next()

    def move(self, poses: dict[int, Correction]) -> None:
        """Corrections by keyframe index, for what is still in the window."""
        self._keyframes = [k.moved(*poses[k.index]) if k.index in poses else k for k in self._keyframes]

    def _next(self) -> tuple[K, list[K]]:
        index = self._waiting.pop(0)
        others = [k for k in self._keyframes if k.index != index]
        return next(k for k in self._keyframes if k.index == index), others


class WindowedStage(ABC, Generic[K, R]):
    """Feeds on keyframes in stream order; `add` and `flush` yield each wanted one's result exactly once, in order."""

    def __init__(self, before: int, lag: int) -> None:
        self._before, self._lag = before, lag
        self._window = KeyframeWindow[K](before, lag)

    def add(self, view: K, wanted: bool = True) -> Iterator[R]:
        """Of the keyframe `lag` before this one; of all that wait if this one starts a new segment or size.

        wanted: whether this one is to get a result too; else it is a neighbor of others only.
        """
        for reference, others in self._window.add(view, wanted):
            yield self._result(reference, others)

    def release(self) -> Iterator[R]:
        """Of the keyframe that has waited longest, though fewer than `lag` came after it."""
        for reference, others in self._window.release():
            yield self._result(reference, others)

    def flush(self) -> Iterator[R]:
        """Of the keyframes that still wait, with the neighbors that are there."""
        for reference, others in self._window.flush():
            yield self._result(reference, others)

    def forget(self) -> None:
        """The keyframes that come next are of another map. None waits: see `flush`."""
        self._window = KeyframeWindow[K](self._before, self._lag)

    @property
    def waiting(self) -> int | None:
        """Index of the keyframe that has waited longest for later ones."""
        return self._window.waiting

    def move(self, poses: dict[int, Correction]) -> None:
        """Corrections by keyframe index, for what is still in the window."""
        self._window.move(poses)

    @abstractmethod
    def _result(self, reference: K, others: list[K]) -> R:
        """others: the keyframes of the window around it."""
