"""What the window of keyframes hands out, and when."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mvsgs_core.keyframe_window import Correction, KeyframeWindow


@dataclass(frozen=True)
class One:
    index: int
    segment: int = 0
    size: tuple[int, int] = (2, 3)
    scale: float = 1.0

    def moved(self, world_from_cam: np.ndarray, scale: float, segment: int | None = None) -> One:
        return replace(self, scale=scale, segment=self.segment if segment is None else segment)


Handed = list[tuple[int, list[int]]]


def handed(window: KeyframeWindow[One], *keyframes: One, wanted: bool = True) -> Handed:
    return [(r.index, [o.index for o in others]) for k in keyframes for r, others in window.add(k, wanted)]


def flushed(window: KeyframeWindow[One]) -> Handed:
    return [(r.index, [o.index for o in others]) for r, others in window.flush()]


def test_each_keyframe_comes_once_late_by_the_lag_with_those_around_it() -> None:
    window = KeyframeWindow[One](before=2, lag=1)
    assert handed(window, *(One(i) for i in range(5))) == [
        (0, [1]), (1, [0, 2]), (2, [0, 1, 3]), (3, [0, 1, 2, 4]),
    ]  # fmt: skip
    assert flushed(window) == [(4, [1, 2, 3])]
    assert flushed(window) == []


def test_without_lag_and_window_a_keyframe_comes_at_once_and_alone() -> None:
    assert handed(KeyframeWindow[One](before=0, lag=0), One(0), One(1)) == [(0, []), (1, [0])]


@pytest.mark.parametrize("other", [One(2, segment=1), One(2, size=(4, 6))])
def test_a_new_segment_or_size_starts_a_new_window(other: One) -> None:
    window = KeyframeWindow[One](before=3, lag=2)
    assert handed(window, One(0), One(1), other) == [(0, [1]), (1, [0])]
    assert flushed(window) == [(2, [])]


def test_who_is_not_wanted_is_one_of_the_others_only() -> None:
    window = KeyframeWindow[One](before=4, lag=1)
    assert handed(window, One(0), One(1), wanted=False) == []
    assert handed(window, One(2), One(3)) == [(2, [0, 1, 3])]


def test_corrections_reach_all_that_is_in_the_window() -> None:
    window = KeyframeWindow[One](before=2, lag=2)
    handed(window, One(0), One(1))
    window.move({0: Correction(np.eye(4), 2.0), 7: Correction(np.eye(4), 3.0)})
    first, second = window.flush()
    assert (first[0].scale, first[1][0].scale) == (2.0, 1.0)
    assert (second[0].scale, second[1][0].scale) == (1.0, 2.0)


def test_keyframes_whose_segment_was_joined_stay_in_the_window() -> None:
    window = KeyframeWindow[One](before=3, lag=2)
    handed(window, One(0, segment=1), One(1, segment=1))
    window.move({i: Correction(np.eye(4), 1.0, segment=0) for i in range(2)})
    assert handed(window, One(2)) == [(0, [1, 2])]
