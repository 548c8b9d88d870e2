"""Which images are let go where there are too many: those whose neighbors in time are closest, so that what is left is
spread evenly."""

from __future__ import annotations

import heapq
from collections.abc import Sequence


def closest(index: Sequence[int], among: range, count: int) -> list[int]:
    """Positions of `count` frames, one after the other: each time that of whose neighbors, of those that are left, the
    indices (ascending) are closest, and of equal ones the first.

    among: positions that may be chosen, at least `count`. The first and the last frame of all have a neighbor right
    beside them. A heap of the gaps, and neighbors that are linked: O(log N) each.
    """
    before, after = list(range(-1, len(index) - 1)), list(range(1, len(index) + 1))

    def gap(k: int) -> int:
        low = index[before[k]] if before[k] >= 0 else index[k] - 1
        high = index[after[k]] if after[k] < len(index) else index[k] + 1
        return high - low

    heap = [(gap(k), k) for k in among]
    heapq.heapify(heap)
    found: dict[int, None] = {}
    while len(found) < count:
        known, k = heapq.heappop(heap)
        if k in found or known != gap(k):
            continue  # its gap has grown since, with which it is here another time
        found[k] = None
        for side, other, end in ((before, after, len(index)), (after, before, -1)):
            neighbor = other[k]
            if neighbor != end:
                side[neighbor] = side[k]
                if neighbor in among:
                    heapq.heappush(heap, (gap(neighbor), neighbor))
    return list(found)


__all__ = ["closest"]
