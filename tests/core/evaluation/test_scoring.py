"""Which frames are scored, and what is said of them: the worst of all, the coverage, how many are behind a mean."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.evaluation.scoring import Score, ScoredFrame, choose, score_frame, summarize
from mvsgs_core.rasterizer.splats import Splats

INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])


def view(index: int, keyframe: bool = False) -> ScoredFrame:
    return ScoredFrame(index, keyframe, np.eye(4), INTRINSICS, lambda: np.full((24, 32, 3), 128, np.uint8), 0.01)


def score(index: int, psnr: float, keyframe: bool = False, coverage: float = 1.0) -> Score:
    return Score(index, keyframe, {"psnr": psnr, "ssim": 0.9, "lpips": None}, coverage)


@pytest.mark.parametrize("limit", [6, 30, 200])
def test_the_last_frames_are_scored_and_the_others_spread_over_the_run(limit: int) -> None:
    views = [view(index, index % 7 == 3) for index in range(1000)]
    chosen = [v.index for v in choose(views, limit)]
    assert chosen == sorted(set(chosen))
    assert limit - 2 <= len(chosen) <= limit
    last = {6: 1, 30: 1, 200: 5}[limit]
    assert chosen[-last:] == list(range(1000 - last, 1000))
    kinds = [sum(i % 7 == 3 for i in chosen), sum(i % 7 != 3 and i % 5 == 0 for i in chosen)]
    assert min(kinds) >= limit // 3 - last
    assert chosen[0] < 20


def test_a_stream_of_few_frames_is_scored_whole() -> None:
    views = [view(index) for index in range(20)]
    assert choose(views, 20) == views


def test_the_worst_of_all_stands_beside_the_worst_of_the_held_out() -> None:
    scores = [score(0, 33.0), score(1, 36.0, keyframe=True), score(4, 20.3, coverage=0.8), score(5, 31.0),
              score(10, 25.0, keyframe=True, coverage=0.97), score(15, 33.0)]  # fmt: skip
    found = summarize(scores)
    assert found["held_out"] == {"psnr": 32.0, "ssim": 0.9, "lpips": None, "count": 2}
    assert found["keyframes"]["count"] == 2
    assert found["all"]["count"] == 6
    assert found["generalization_gap"] == pytest.approx((36.0 + 25.0) / 2 - 32.0)
    assert found["held_out_fitted"] == {"psnr": None, "ssim": None, "lpips": None, "count": 0}
    assert found["worst"]["held_out"]["index"] == 5
    worst = found["worst"]["all"]
    assert (worst["index"], worst["psnr"], worst["keyframe"], worst["held_out"]) == (4, 20.3, False, False)
    assert found["coverage"] == {"mean": pytest.approx(5.77 / 6), "min": 0.8, "min_index": 4, "count": 6}
    assert [frame["index"] for frame in found["frames"]] == [0, 1, 4, 5, 10, 15]
    held_out = [frame["index"] for frame in found["frames"] if frame["held_out"]]
    assert held_out == [5, 15], "0 is the first frame, 10 became a keyframe"
    assert set(found["frames"][0]) == {"index", "keyframe", "held_out", "psnr", "ssim", "lpips", "coverage", "kind",
                                       "fitted"}  # fmt: skip
    assert [frame["kind"] for frame in found["frames"]][2:5] == ["between keyframes", "held out", "keyframe"]


def test_the_protocol_that_fits_cameras_stands_beside_the_strict_one() -> None:
    fitted = Score(
        5, False, {"psnr": 30.0, "ssim": 0.9, "lpips": None}, 1.0, {"psnr": 34.0, "ssim": 0.94, "lpips": None}
    )
    found = summarize([fitted, score(6, 31.0, keyframe=True), score(10, 20.0)])
    assert found["held_out"] == {"psnr": 25.0, "ssim": 0.9, "lpips": None, "count": 2}
    assert found["held_out_fitted"] == {"psnr": 34.0, "ssim": 0.94, "lpips": None, "count": 1}
    assert found["worst"]["held_out"]["index"] == 10
    assert found["frames"][0]["psnr"] == 30.0
    assert found["frames"][0]["fitted"]["psnr"] == 34.0
    assert found["frames"][2]["fitted"] is None
    assert summarize([score(0, 30.0)])["generalization_gap"] is None  # nothing to compare with


def test_of_no_frame_nothing_is_said() -> None:
    found = summarize([])
    assert found["worst"] == {"held_out": None, "all": None}
    assert found["coverage"] == {"mean": None, "min": None, "min_index": None, "count": 0}
    assert found["frames"] == []


def test_coverage_is_the_fraction_of_pixels_that_the_map_shows() -> None:
    """A wall of opaque splats over the left half of the image, and one too faint to count over all of it."""
    x, y = np.meshgrid(np.linspace(-1.1, 0.0, 40), np.linspace(-0.9, 0.9, 40))
    count = x.size + 1
    means = torch.zeros(count, 3)
    means[1:, 0], means[1:, 1] = torch.from_numpy(x.ravel()).float(), torch.from_numpy(y.ravel()).float()
    means[:, 2] = 2.0
    log_scales = torch.full((count, 3), float(np.log(0.02)))
    log_scales[0] = float(np.log(2.0))
    logits = torch.full((count,), 4.0)
    logits[0] = -0.5
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1.0
    splats = Splats(means, log_scales, quaternions, logits, torch.zeros(count, 1, 3), torch.full((count,), 2.0))
    found = score_frame(splats, "gaussian", view(3))
    assert found.coverage == pytest.approx(0.5, abs=0.06)
