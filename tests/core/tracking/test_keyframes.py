"""The table of keyframes knows what a walk through them finds, whatever came, went or changed."""

from __future__ import annotations

import copy
import pickle

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.keyframes import FIRST, Keyframe, KeyframeTable

GRAY = np.zeros((16, 16), np.uint8)


def keyframe(index: int, segment: int = 0) -> Keyframe:
    pose = geometry.se3_exp(np.array([0.1 * index, 0, 0, 0, 0.01 * index, 0.0]))
    return Keyframe(TrackingImage(index, 0.0, GRAY), pose, np.ones(4), np.zeros(4), segment)


def check(table: KeyframeTable) -> None:
    for segment in range(3):
        assert table.members(segment) == sorted(i for i, k in table.items() if k.segment == segment)
    order = list(table)
    assert np.array_equal(table.poses(order), np.stack([table[i].cam_from_world for i in order]))


def test_table_is_what_a_walk_finds() -> None:
    random, table = np.random.default_rng(0), KeyframeTable()
    for _ in range(6 * FIRST):
        index = int(random.integers(-FIRST, 2 * FIRST))
        if index not in table or random.random() < 0.2:
            table[index] = keyframe(index, int(random.integers(3)))
        elif random.random() < 0.5:
            del table[index]
        else:
            table[index].segment = int(random.integers(3))
            table[index].cam_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    assert len(table) > FIRST
    check(table)
    for other in (copy.deepcopy(table), pickle.loads(pickle.dumps(table))):
        assert list(other) == list(table)
        other[next(iter(other))].segment = 2
        check(other)
    check(table)


def test_changes_since_a_time() -> None:
    table = KeyframeTable([(n, keyframe(n)) for n in range(5)])
    since = table.clock
    assert table.changed(since) == set()
    table[3].inverse_depth = np.full(4, 2.0)
    gone = table[1]
    del table[1]
    gone.segment = 1  # no longer the table's
    table[7] = keyframe(7)
    assert table.changed(since) == {3, 7}
    assert table.members(0) == [0, 2, 3, 4, 7]
