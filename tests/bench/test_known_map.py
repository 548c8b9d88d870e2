"""Errors on a known map beside those of one run: of the same frames, aligned by the same ones."""

from __future__ import annotations

import argparse

import numpy as np
import pytest

from bench.known_map import QUICK, compared, errors, mapped

RANDOM = np.random.default_rng(0)
TRUTHS = {k: RANDOM.normal(size=3) for k in range(20)}  # ten of each half


def off(frames: range, by: float) -> dict[int, np.ndarray]:
    """In units and a frame of reference of their own, each by so much from the truth."""
    return {k: 3.0 * (TRUTHS[k] + by * RANDOM.normal(size=3)) + [1.0, 2.0, 3.0] for k in frames}


def test_frames_that_the_map_has_not_tell_nothing_of_the_one_run() -> None:
    extended = off(range(0, 20, 2), 0.01)
    one = off(range(1, 20, 2), 5.0) | extended
    on_map, alone = compared(extended, one, TRUTHS, 10)
    assert on_map == pytest.approx(alone)
    assert on_map < 0.05


def test_a_frame_that_only_one_of_them_has_or_whose_truth_is_not_known_does_not_count() -> None:
    one = off(range(20), 0.01)
    extended = {**one, 12: np.array([1e6, 0.0, 0.0])}
    del one[12]
    truths = {k: truth for k, truth in TRUTHS.items() if k != 14}
    one[14] = np.array([0.0, 1e6, 0.0])
    on_map, alone = compared(extended, one, truths, 10)
    assert on_map == pytest.approx(alone)


def test_errors_are_those_of_the_chosen_frames_aligned_by_others() -> None:
    found = off(range(20), 0.0)
    found[15] = found[15] + [3.0, 0.0, 0.0]
    assert errors(found, TRUTHS, [14, 15], list(range(10))) == pytest.approx([0.0, 1.0], abs=1e-9)


def test_the_quick_run_maps_its_own_scene_whichever_are_named() -> None:
    options = argparse.Namespace(quick=True, part="all", maps=["redkitchen"])
    assert mapped(options) == QUICK
