from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.evaluation.depth_metrics import NO_DEPTH, depth_ratios, score_depth
from mvsgs_core.evaluation.metrics import DEPTH, of_all


def test_counts_only_what_both_know() -> None:
    truth = np.full((4, 6), 2.0, np.float32)
    truth[0] = 0  # no true depth in the first row
    depth = np.full((4, 6), 1.0, np.float32)  # at half the scale
    depth[:, 0] = 0  # filtered out
    depth[1, 1] = 1.2  # 20 % off
    summary = of_all(DEPTH, score_depth(depth, truth, scale=2.0))
    assert summary["completeness"] == pytest.approx(15 / 18)
    assert summary["inlier_ratio"] == pytest.approx(14 / 15)
    assert summary["abs_rel"] == pytest.approx(0.2 / 15, rel=1e-5)


def test_scores_add_up() -> None:
    truth = np.full((8, 8), 3.0, np.float32)
    good = score_depth(truth, truth, 1.0)
    bad = score_depth(truth * 1.5, truth, 1.0)
    both = of_all(DEPTH, NO_DEPTH + good + bad)
    assert both["abs_rel"] == pytest.approx(0.25)
    assert both["inlier_ratio"] == pytest.approx(0.5)
    assert of_all(DEPTH, NO_DEPTH) == {"abs_rel": None, "inlier_ratio": None, "completeness": None}


def test_truth_is_read_at_pixel_centers_without_mixing_edges() -> None:
    truth = np.ones((40, 40), np.float32)
    truth[:, 20:] = 10.0
    depth = np.ones((20, 20), np.float32)
    depth[:, 10:] = 10.0
    assert score_depth(depth, truth, 1.0).abs_rel() == 0.0


def test_values_that_are_not_finite_are_no_estimate() -> None:
    truth = np.ones((4, 4), np.float32)
    depth = np.ones((4, 4), np.float32)
    depth[0, 0], depth[0, 1] = np.nan, np.inf
    assert score_depth(depth, truth, 1.0).estimated == 14


def test_ratios_are_of_pixels_that_have_both() -> None:
    truth = np.full((20, 30), 3.0, np.float32)
    truth[:10] = 0
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, :5] = np.nan
    ratios = depth_ratios(depth, truth, every=1)
    assert len(ratios) == 10 * 25
    assert np.allclose(ratios, 1.5)
    assert len(depth_ratios(depth * 0, truth)) == 0
