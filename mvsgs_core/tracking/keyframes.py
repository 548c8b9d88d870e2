"""Keyframes by their index, and beside them arrays of what is asked of all of them: index, segment, pose, last change.

What a new keyframe asks of the whole map is so answered by a few operations on arrays, not by a walk through objects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvsgs_core.tracking.estimation.static_points import STILL
from mvsgs_core.tracking.image import TrackingImage

FIRST = 64  # rows of the arrays, doubled when they are full


@dataclass
class Keyframe:
    """A kept frame. M points, one a cell; the map's unit is the median depth of the first keyframes.

    What changes is set as a whole, never in place: so the table that holds the keyframe is told.
    """

    image: TrackingImage
    cam_from_world: np.ndarray  # (4, 4) float64
    inverse_depth: np.ndarray  # (M,) float64
    information: np.ndarray  # (M,) float64 of the inverse depth, pixels^-2; 0: never triangulated
    segment: int
    static: np.ndarray = field(init=False)  # (M,) weight of each point, see `static_points`; 1 where nothing is known

    def __post_init__(self) -> None:
        self.static = np.ones(len(self.inverse_depth))

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)
        table = self.__dict__.get("_table")
        if table is not None:
            table.note(self)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_table"}

    @property
    def index(self) -> int:
        return self.image.index

    @property
    def points(self) -> np.ndarray:
        """(M, 2) float32."""
        return self.image.cells.points

    @property
    def triangulated(self) -> np.ndarray:
        """(M,) bool: the depth is known to better than about 30 %, for an error of one pixel."""
        return self.information * self.inverse_depth**2 > 10.0

    @property
    def still(self) -> np.ndarray:
        """(M,) bool: nothing says that the point moves."""
        return self.static > STILL

    @property
    def median_depth(self) -> float:
        known = self.triangulated
        return float(1.0 / np.median(self.inverse_depth[known] if known.sum() > 10 else self.inverse_depth))


class KeyframeTable(dict[int, Keyframe]):
    """A dictionary that is changed by `table[index] = keyframe` and `del table[index]` only."""

    def __init__(self, keyframes: Iterable[tuple[int, Keyframe]] = ()) -> None:
        super().__init__()
        self.clock = 0  # changes so far
        self._index = np.empty(FIRST, np.int64)  # ascending
        self._segment = np.empty(FIRST, np.int64)
        self._pose = np.empty((FIRST, 4, 4))
        self._changed = np.empty(FIRST, np.int64)  # the clock then
        for index, keyframe in keyframes:
            self[index] = keyframe

    def __reduce__(self) -> tuple[Any, ...]:
        return KeyframeTable, (), None, None, iter(self.items())

    def __setitem__(self, index: int, keyframe: Keyframe) -> None:
        if index in self:
            del self[index]
        count = len(self)
        if count == len(self._index):
            for name in ("_index", "_segment", "_pose", "_changed"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.empty_like(old)]))
        row = self._row(index)
        for column in (self._index, self._segment, self._pose, self._changed):
            column[row + 1 : count + 1] = column[row:count]
        self._index[row] = index
        super().__setitem__(index, keyframe)
        keyframe.__dict__["_table"] = self
        self.note(keyframe, index)

    def __delitem__(self, index: int) -> None:
        row, count = self._row(index), len(self)
        self[index].__dict__.pop("_table", None)
        super().__delitem__(index)
        for column in (self._index, self._segment, self._pose, self._changed):
            column[row : count - 1] = column[row + 1 : count]

    def note(self, keyframe: Keyframe, index: int | None = None) -> None:
        """A keyframe is another than it was."""
        row = self._row(keyframe.index if index is None else index)
        self.clock += 1
        self._segment[row], self._pose[row], self._changed[row] = (
            keyframe.segment,
            keyframe.cam_from_world,
            self.clock,
        )

    def members(self, segment: int) -> list[int]:
        """Indices of a segment's keyframes, ascending."""
        count = len(self)
        found: list[int] = self._index[:count][self._segment[:count] == segment].tolist()
        return found

    def poses(self, indices: Sequence[int]) -> np.ndarray:
        """(N, 4, 4) cam_from_world of these."""
        return self._pose[np.searchsorted(self._index[: len(self)], np.asarray(indices, np.int64))]

    def changed(self, since: int) -> set[int]:
        """Indices of those that came or changed after the clock showed `since`."""
        count = len(self)
        return set(self._index[:count][self._changed[:count] > since].tolist())

    def _row(self, index: int) -> int:
        return int(np.searchsorted(self._index[: len(self)], index))


__all__ = ["Keyframe", "KeyframeTable"]
