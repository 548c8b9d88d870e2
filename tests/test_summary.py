"""The lines at the end of a run: what is behind each figure, and the worst of it."""

from __future__ import annotations

from typing import Any

from launch.output import RESULTS
from launch.summary import FILES, _figures
from mvsgs_core.evaluation.scoring import Score, summarize
from mvsgs_core.kept_map import FOLDER


def report(after: list[Score], before: list[Score]) -> dict[str, Any]:
    return {
        "rendering": summarize(after),
        "rendering_before_refinement": summarize(before),
        "trajectory": {"frames": 9, "frames_tracked": 8, "keyframes": 4, "ate_rmse": 0.012, "ate_keyframes": 3},
        "depth": {"abs_rel": 0.02, "inlier_ratio": 0.9, "completeness": 0.5, "scale_ratio": 1.0, "count": 2},
    }


SCORES = [
    Score(5, False, {"psnr": 33.0, "ssim": 0.9, "lpips": None}, 1.0),
    Score(3, True, {"psnr": 35.0, "ssim": 0.9, "lpips": None}, 0.995),
    Score(8, False, {"psnr": 20.3, "ssim": 0.8, "lpips": None}, 0.87),
]


def test_the_worst_frame_the_least_covered_and_the_counts_are_shown() -> None:
    lines = _figures(report(SCORES, []))
    assert lines[:3] == [
        "keyframes   PSNR 35.00 dB, SSIM 0.900, 1 frames",
        "held-out    PSNR 33.00 dB, SSIM 0.900, 1 frames",
        "worst       frame 8 (between keyframes): PSNR 20.30 dB; least covered: frame 8, 87.0 % (of 3 frames)",
    ]
    assert any("RMSE of 3 keyframes" in line for line in lines)
    assert any(line.startswith("depth") and line.endswith("2 keyframes") for line in lines)


def test_the_figures_with_fitted_cameras_stand_below_the_strict_ones() -> None:
    fitted = [
        Score(5, False, {"psnr": 33.0, "ssim": 0.9, "lpips": None}, 1.0, {"psnr": 34.5, "ssim": 0.92, "lpips": None})
    ]
    lines = _figures(report(fitted, []))
    assert lines[:2] == [
        "held-out    PSNR 33.00 dB, SSIM 0.900, 1 frames",
        "  fitted    PSNR 34.50 dB, SSIM 0.920, 1 frames, their poses and exposures fitted at test time",
    ]
    assert not any("fitted" in line for line in _figures(report(SCORES, [])))


def test_a_map_that_was_never_refined_has_a_worst_frame_too() -> None:
    assert any(line.startswith("worst       frame 8") for line in _figures(report([], SCORES)))


def test_a_report_of_nothing_is_no_error() -> None:
    assert not [line for line in _figures(report([], [])) if line.startswith("worst")]
    assert _figures({"finished": False, "reason": "stopped"}) == []


def test_every_result_is_named_where_it_is_there() -> None:
    assert set(RESULTS) - {FOLDER} <= set(FILES)
