"""Images that are let go: the same as if each were looked for among all, in far less time."""

from __future__ import annotations

import time

import numpy as np
import pytest

from mvsgs_core.mapping.thinning import closest


def one_by_one(index: list[int], among: range, count: int) -> list[int]:
    """The rule, as it is said."""
    left, found = list(range(len(index))), []
    for _ in range(count):
        order = [index[left[0]] - 1, *(index[k] for k in left), index[left[-1]] + 1]
        place = min((p for p, k in enumerate(left) if k in among), key=lambda p: order[p + 2] - order[p])
        found.append(left.pop(place))
    return found


@pytest.mark.parametrize("seed", range(30))
def test_those_go_whose_neighbors_are_closest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    length = int(rng.integers(1, 40))
    index = np.sort(rng.choice(int(rng.choice([length, 2 * length, 1000])), length, replace=False)).tolist()
    ends = [range(length), range(1, max(1, length - int(rng.integers(1, 7))))]
    for among in ends:
        for count in {0, 1, len(among) // 2, len(among)} & set(range(len(among) + 1)):
            assert closest(index, among, count) == one_by_one(index, among, count)


def test_a_join_of_long_maps_does_not_hold_the_stream_up() -> None:
    start = time.process_time()
    found = closest(list(range(60_000)), range(1, 59_990), 50_000)
    assert time.process_time() - start < 5.0, "each looked for among all: minutes"
    assert len(set(found)) == 50_000
