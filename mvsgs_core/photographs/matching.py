"""Matches of two photographs, and which pairs of many are worth matching."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from mvsgs_core.geodesy import earth_centered
from mvsgs_core.photographs.features import Features

RATIO = 0.8  # of the distances to the best and the second best (Lowe 2004)
BLOCK = 512  # features whose similarities are looked at while they are in the cache
FIRST = 200  # features of a photograph, of the largest scale, that propose its pairs
EXHAUSTIVE = 30  # photographs: of so many all pairs are matched
COPY = 0.7  # of these features are matched between two photographs from one place
COPIES = 3  # of a photograph that it is matched with
TOGETHER = 256  # photographs that one is compared with at once, for memory's sake


def match(a: Features, b: Features) -> np.ndarray:
    """Pairs (N, 2) int64 of features that are each other's best match and pass the ratio test in `a`."""
    count, others = len(a.points), len(b.points)
    if min(count, others) < 2:
        return np.zeros((0, 2), np.int64)
    best, first, second = np.zeros(count, np.int64), np.zeros(count, np.float32), np.zeros(count, np.float32)
    back = np.full(others, -1.0, np.float32)  # similarity of each feature of `b` to the best of `a`
    for begin in range(0, count, BLOCK):
        rows = slice(begin, min(begin + BLOCK, count))
        similarity = a.descriptors[rows] @ b.descriptors.T
        np.maximum(back, similarity.max(axis=0), out=back)
        at = np.arange(len(similarity))
        best[rows] = similarity.argmax(axis=1)
        first[rows] = similarity[at, best[rows]]
        similarity[at, best[rows]] = -1.0
        second[rows] = similarity.max(axis=1)
    distinct = np.maximum(1.0 - first, 0.0) < RATIO**2 * (1.0 - second)  # squared distances over two
    mutual = np.flatnonzero((first == back[best]) & distinct)
    _, once = np.unique(best[mutual], return_index=True)  # two that are equally alike are one match
    mutual = mutual[np.sort(once)]
    return np.stack([mutual, best[mutual]], axis=1)


def propose_pairs(features: list[Features], neighbors: int) -> list[tuple[int, int]]:
    """Pairs (i < j) that share enough features of a large scale (preemptive matching, Wu 2013), those most alike first.

    Each photograph brings its `neighbors` most alike; of few photographs all pairs are proposed. Copies (bursts, a
    camera at rest) count as one: however many there are, each place is matched with others.
    """
    count = len(features)
    alike = likeness(features)
    if count > EXHAUSTIVE:
        pairs = {(min(i, j), max(i, j)) for i in range(count) for j in _most_alike(alike, i, neighbors)}
    else:
        pairs = set(combinations(range(count), 2))
    return sorted(pairs, key=lambda pair: (-alike[pair], pair))


def _most_alike(alike: np.ndarray, of: int, count: int) -> list[int]:
    """Up to `count` photographs, those most alike first: `COPIES` of itself at most, and one of others' copies."""
    chosen: list[int] = []
    copies = 0
    for other in np.argsort(-alike[of], kind="stable").tolist():
        if len(chosen) == count or alike[of, other] <= 0:
            break
        if alike[of, other] >= COPY * FIRST:
            copies += 1
            if copies > COPIES:
                continue
        elif (alike[other, chosen] >= COPY * FIRST).any():
            continue
        chosen.append(other)
    return chosen


def near_pairs(places: list[np.ndarray | None], nearest: int) -> list[tuple[int, int]]:
    """Pairs (i < j) of photographs of which one is among the `nearest` of the other, by their places (geodesy)."""
    known = [n for n, place in enumerate(places) if place is not None]
    if len(known) < 2:
        return []
    at = earth_centered(np.stack([place for place in places if place is not None]))
    pairs = set()
    for n, here in enumerate(at):
        away = np.sum((at - here) ** 2, axis=1)
        away[n] = np.inf
        others = np.argsort(away, kind="stable")[: min(nearest, len(known) - 1)].tolist()
        pairs |= {(min(known[n], known[m]), max(known[n], known[m])) for m in others}
    return sorted(pairs)


def likeness(features: list[Features]) -> np.ndarray:
    """(N, N) number of matches among the `FIRST` features of each; 0 with itself."""
    count = len(features)
    first = np.zeros((count, FIRST, 128), np.float32)  # an empty place is like nothing
    for n, found in enumerate(features):
        part = found.descriptors[:FIRST]
        first[n, : len(part)] = part
    alike = np.zeros((count, count))
    for n, begin in ((k, begin) for k in range(count - 1) for begin in range(k + 1, count, TOGETHER)):
        others = first[begin : begin + TOGETHER]
        similarity = (others.reshape(-1, 128) @ first[n].T).reshape(len(others), FIRST, FIRST)
        best, back = similarity.argmax(axis=2), similarity.argmax(axis=1)
        value = np.take_along_axis(similarity, best[..., None], axis=2)
        np.put_along_axis(similarity, best[..., None], -1.0, axis=2)
        mutual = np.take_along_axis(back, best, axis=1) == np.arange(FIRST)
        distinct = 1.0 - value[..., 0] < RATIO**2 * (1.0 - similarity.max(axis=2))
        shared = (mutual & distinct & (value[..., 0] > 0.0)).sum(axis=1)
        alike[n, begin : begin + len(others)] = alike[begin : begin + len(others), n] = shared
    return alike


__all__ = ["likeness", "match", "near_pairs", "propose_pairs"]
