"""The edges of a keyframe graph: matches of one keyframe's points in another, with those of a keyframe at hand.

What is asked of a large graph is nearly always about few keyframes, so that it takes as long as in a small one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, MutableMapping

import numpy as np

Pair = tuple[int, int]  # of frame indices: source, target


class Edge:
    """Where the points of one keyframe were found in another. A lost point takes a bit: about half of them are.

    An edge is replaced by another one, never changed.
    """

    __slots__ = ("_found", "_points", "_target", "_velocity", "_weight", "fraction")

    def __init__(self, target: np.ndarray, weight: np.ndarray, velocity: np.ndarray, fraction: float) -> None:
        """target (2, M) pixels; weight (M,) 0 to 1, 0: lost; velocity (2, M) of the image at the target, pixels a
        second; fraction: of the textured points that were found."""
        weight = weight.astype(np.float16)
        found = weight > 0
        self._points, self._found = len(weight), np.packbits(found)
        self._target, self._velocity = target[:, found].astype(np.float32), velocity[:, found].astype(np.float16)
        self._weight, self.fraction = weight[found], fraction

    @property
    def found(self) -> np.ndarray:
        """(M,) bool."""
        return np.unpackbits(self._found, count=self._points).view(bool)

    @property
    def of_found(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Target (2, N), velocity (2, N) and weight (N,) of the points that were found."""
        return self._target, self._velocity, self._weight

    @property
    def target(self) -> np.ndarray:
        """(2, M) float32, 0 where lost."""
        return self._whole(self._target)

    @property
    def weight(self) -> np.ndarray:
        """(M,) float16, 0 to 1."""
        return self._whole(self._weight)

    @property
    def velocity(self) -> np.ndarray:
        """(2, M) float16, 0 where lost."""
        return self._whole(self._velocity)

    @property
    def matches(self) -> int:
        """Points that were found."""
        return len(self._weight)

    def _whole(self, values: np.ndarray) -> np.ndarray:
        """(..., M) of values (..., N) of the points that were found."""
        whole = np.zeros((*values.shape[:-1], self._points), values.dtype)
        whole[..., self.found] = values
        return whole


class Edges(MutableMapping[Pair, Edge]):
    """In the order in which pairs came. What is set again keeps its place."""

    def __init__(self) -> None:
        self._edges: dict[Pair, Edge] = {}
        self._place: dict[Pair, int] = {}  # in that order
        self._at: dict[int, list[Pair]] = {}  # by keyframe: those that begin or end there
        self._came = 0
        self._log: list[Pair] = []  # what was set or removed, for `changes`

    def __getitem__(self, pair: Pair) -> Edge:
        return self._edges[pair]

    def __setitem__(self, pair: Pair, edge: Edge) -> None:
        if pair not in self._edges:
            self._place[pair] = self._came
            self._came += 1
            for index in set(pair):
                self._at.setdefault(index, []).append(pair)
        self._edges[pair] = edge
        self._log.append(pair)

    def __delitem__(self, pair: Pair) -> None:
        del self._edges[pair], self._place[pair]
        for index in set(pair):
            self._at[index].remove(pair)
        self._log.append(pair)

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._edges)

    def __len__(self) -> int:
        return len(self._edges)

    def __contains__(self, pair: object) -> bool:
        return pair in self._edges

    def __ior__(self, other: Mapping[Pair, Edge]) -> Edges:
        self.update(other)
        return self

    def of(self, indices: Iterable[int]) -> list[Pair]:
        """Those that begin or end at one of these keyframes, in order."""
        found = {pair for index in indices for pair in self._at.get(index, ())}
        return sorted(found, key=self._place.__getitem__)

    def reached(self, indices: Iterable[int]) -> set[int]:
        """These keyframes, and those that an edge ties to one of them."""
        indices = set(indices)
        return indices | {end for index in indices for pair in self._at.get(index, ()) for end in pair}

    def changes(self, since: int) -> tuple[list[Pair], int]:
        """Pairs that were set or removed after the first `since` changes: what is there in order, then what is not.

        And how many changes there were by now.
        """
        changed = set(self._log[since:])
        there = sorted((pair for pair in changed if pair in self._edges), key=self._place.__getitem__)
        return there + sorted(changed - self._edges.keys()), len(self._log)


__all__ = ["Edge", "Edges", "Pair"]
