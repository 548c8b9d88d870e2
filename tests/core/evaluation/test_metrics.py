"""A metric is one entry: what is scored, summarized and shown follows from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from launch.summary import _figures
from mvsgs_core.evaluation import html, metrics
from mvsgs_core.evaluation.depth_metrics import NO_DEPTH
from mvsgs_core.evaluation.metrics import Metric
from mvsgs_core.evaluation.scoring import ScoredFrame, score_frame, summarize, worst_of
from tests.support.small_maps import empty_map


def frame(index: int, gray: int) -> ScoredFrame:
    lens = np.array([30.0, 30.0, 15.5, 11.5])
    return ScoredFrame(index, False, np.eye(4), lens, lambda: np.full((24, 32, 3), gray, np.uint8), 0.01)


def test_a_render_that_equals_its_photograph_leaves_the_means_finite() -> None:
    scores = [score_frame(empty_map(), "gaussian", frame(index, gray)) for index, gray in ((5, 0), (10, 51))]
    found = summarize(scores)
    assert scores[0].figures["psnr"] == metrics.BEST_PSNR == 100.0
    assert found["held_out"]["psnr"] == pytest.approx((100.0 + 13.98) / 2, abs=0.01)
    assert summarize([scores[0], replace(scores[0], index=1, keyframe=True)])["generalization_gap"] == 0.0


def test_a_new_entry_is_scored_ranked_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    brightness = Metric("mae", "mean error", "%", 1, "lower", of=lambda a, b: float(np.abs(a - b).mean()), factor=100)
    monkeypatch.setattr(metrics, "IMAGE", (brightness, *metrics.IMAGE))
    scores = [score_frame(empty_map(), "gaussian", frame(index, gray)) for index, gray in ((5, 51), (10, 102))]
    assert [round(score.entry()["mae"], 3) for score in scores] == [0.2, 0.4]
    assert worst_of(scores).index == 10
    report = {"rendering": summarize(scores), "rendering_before_refinement": summarize([])}
    assert report["rendering"]["all"]["mae"] == pytest.approx(0.3)
    assert "<th>mean error %</th>" in html.rendering_table(report)
    assert "<td>30.0</td>" in html.rendering_table(report)
    assert any("mean error 30.0 %, PSNR" in line for line in _figures(report))


def test_a_metric_made_at_run_time_takes_its_place() -> None:
    distance = {"lpips": lambda render, photograph: 0.25}
    assert score_frame(empty_map(), "gaussian", frame(0, 51)).figures["lpips"] is None
    assert score_frame(empty_map(), "gaussian", frame(0, 51), distance).figures["lpips"] == 0.25


def test_entries_are_found_by_their_place_in_the_report() -> None:
    assert metrics.at("rendering_before_refinement.keyframes.ssim").label == "SSIM"
    assert metrics.at("time.cpu.mapper").unit == "s"
    with pytest.raises(KeyError, match=r"rendering\.psnr_of_nothing.*trajectory\.ate_rmse"):
        metrics.at("rendering.psnr_of_nothing")
    labels = [metric.label for metric in metrics.METRICS.values()]
    assert len(set(labels)) == len(labels)  # they head columns


def test_texts_have_digits_unit_and_a_mark_for_nothing() -> None:
    assert metrics.at("map.bytes").text(12_345_678) == "12.3 MB"
    assert metrics.at("map.splats").text(12_345) == "12,345"
    assert metrics.at("rendering.all.psnr").text(None) == "–"
    assert metrics.listed(metrics.IMAGE, {"psnr": 31.2, "ssim": None}) == "PSNR 31.20 dB"
    assert metrics.of_all(metrics.DEPTH, NO_DEPTH) == metrics.of_all(metrics.DEPTH, None)


def test_a_report_is_asked_by_place() -> None:
    report = {"map": {"splats": 7, "kept": True}, "rendering": None}
    assert metrics.value(report, "map") == report["map"]
    assert metrics.number(report, "map.splats") == 7.0
    for place in ("map.kept", "map.bytes", "map.splats.most", "rendering.held_out.psnr", "depth"):
        assert metrics.number(report, place) is None
