"""Which keyframes to join by edges: neighbors in time, then by distance with suppression (DROID-SLAM, section 3.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mvsgs_core.droid.video import Video

Pair = tuple[int, int]
_APART = 100.0  # cells: beyond, two frames share nothing


def neighborhood(count: int, reach: int) -> list[Pair]:
    """Both directions between all of `count` keyframes that are at most `reach` apart."""
    return [(i, j) for i in range(count) for j in range(count) if 0 < abs(i - j) <= reach]


def by_proximity(
    video: Video,
    *,
    first_source: int,
    first_to: int,
    existing: Iterable[Pair],
    radius: int,
    nms: int,
    threshold: float,
    beta: float,
    limit: int,
) -> list[Pair]:
    """Edges, both ways, of keyframes from `first_source` on with those from `first_to` on before them.

    Each is linked with the `radius` + 1 before it; then the nearest pairs farther apart in time, none beside another
    (`nms`), none above `threshold` cells, until there are more than `limit` edges.
    """
    count = len(video)
    distance = {
        (i, j): np.inf for i in range(first_source, count) for j in range(first_to, count)
    }  # infinite: not to be chosen
    open_pairs = [(i, j) for i, j in distance if i - radius >= j]
    if open_pairs:
        a, b = np.array(open_pairs).T
        found = video.distances(a, b, beta)
        distance.update({pair: d for pair, d in zip(open_pairs, found.tolist()) if d <= _APART})
    for pair in existing:
        _suppress(distance, pair, nms)
    chosen: list[Pair] = []
    for i in range(first_source, count):
        for j in range(max(i - radius - 1, 0), i):
            chosen += [(i, j), (j, i)]
            if (i, j) in distance:
                distance[i, j] = np.inf
    for i, j in sorted((p for p in distance if distance[p] <= threshold), key=lambda p: (distance[p], p)):
        if distance[i, j] > threshold:  # suppressed meanwhile
            continue
        if len(chosen) > limit:
            break
        chosen += [(i, j), (j, i)]
        _suppress(distance, (i, j), nms)
    return chosen


def _suppress(distance: dict[Pair, float], pair: Pair, nms: int) -> None:
    for beside in _beside(pair, nms):
        if beside in distance:
            distance[beside] = np.inf


def _beside(pair: Pair, nms: int) -> Iterator[Pair]:
    i, j = pair
    reach = max(min(abs(i - j) - 2, nms), 0)
    for di in range(-reach, reach + 1):
        for dj in range(abs(di) - reach, reach - abs(di) + 1):
            yield i + di, j + dj


__all__ = ["Pair", "by_proximity", "neighborhood"]
