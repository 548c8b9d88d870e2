"""The evaluator as a node: what a run sends goes in, the report files come out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import GroundTruth, SplatMap, TrackingState, Trajectory, View
from mvsgs_core import geometry
from mvsgs_core.evaluation.scoring import render_view
from nodes.evaluator import Evaluator

H, W, N, SCALE = 24, 32, 12, 0.5  # the estimate's unit is 2 true units
INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])
ORIGIN = np.array([1e6, -2e6, 3e6])


def _poses() -> np.ndarray:
    poses = np.tile(np.eye(4), (N, 1, 1))
    for k in range(N):
        poses[k] = geometry.se3_exp(np.array([0.1 * k, 0.03 * np.sin(k), 0.02 * k, 0, 0.01 * k, 0]))
    return poses


def _splat_map(refined: bool) -> SplatMap:
    """A wall of splats 2 units in front of the cameras, redder after the refinement."""
    x, y = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 30))
    n = x.size
    keyframes = np.arange(0, N, 3)
    world_from_cam = _poses()[keyframes]
    world_from_cam[:, :3, 3] += ORIGIN
    return SplatMap(
        refined=refined,
        iterations=100,
        density="gaussian",
        origin=ORIGIN,
        means=np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], axis=1).astype(np.float32),
        log_scales=np.full((n, 3), np.log(0.1), np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        opacity_logits=np.full(n, 4.0, np.float32),
        sh=np.tile(np.array([[(0.8 if refined else 0.4) - 0.5, -0.3, -0.3]], np.float32) / 0.2820948, (n, 1, 1)),
        betas=np.full(n, 2.0, np.float32),
        anchors=np.zeros(n, np.int64),
        keyframes=keyframes,
        world_from_cam=world_from_cam,
        scale=np.ones(len(keyframes)),
        exposures=np.tile(np.eye(3, 4, dtype=np.float32), (len(keyframes), 1, 1)),
    )


@pytest.fixture
def evaluator(tmp_path: Path) -> Evaluator:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    poses = _poses()
    for k in range(N):
        true_pose = poses[k].copy()
        true_pose[:3, 3] *= 1 / SCALE
        image = np.full((H, W, 3), (204, 51, 51), np.uint8)
        depth = np.full((H, W), 4.0, np.float32)
        assert not list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, true_pose, depth)))
    return node


def _feed(node: Evaluator, lost: tuple[int, ...] = ()) -> dict[str, Any]:
    world_from_cam = _poses()
    world_from_cam[:, :3, 3] += ORIGIN
    state = np.zeros(N, np.uint8)
    for k in lost:
        state[k], world_from_cam[k] = TrackingState.LOST, np.nan
    index = np.arange(N)
    keyframe = (index % 3 == 0) & (state == 0)
    list(node.on_trajectory(Trajectory(index, index / 30, world_from_cam, keyframe, state, np.zeros(N, np.int32))))
    depth = np.full((H // 2, W // 2), 2.0, np.float32)
    image = np.zeros((H, W, 3), np.uint8)
    normals = np.zeros((H // 2, W // 2, 3), np.float32)
    view = View(3, 0.1, image, INTRINSICS, world_from_cam[3], 1.0, depth, np.ones_like(depth), normals, 0)
    list(node.on_view(view))
    for refined in (False, True):
        list(node.on_splat_map(_splat_map(refined)))
    node.upstream = {
        "tracker": {"seconds": {"flow": 1.5}, "peak_bytes": 5, "skipped": {"frames": 2}, "warnings": ["w"]}
    }
    list(node.on_end())
    assert node.folder is not None
    report: dict[str, Any] = json.loads((node.folder / "report.json").read_text())
    return report


def test_report(evaluator: Evaluator) -> None:
    report = _feed(evaluator)
    after, before = report["rendering"], report["rendering_before_refinement"]
    assert after["keyframes"]["count"] == 4
    assert after["held_out"]["count"] == 2  # frames 5 and 10; 0 is a keyframe
    assert after["all"]["count"] == N
    assert after["keyframes"]["psnr"] > 35 > 15 > before["keyframes"]["psnr"]  # the far origin costs no precision
    assert after["all"]["lpips"] is None
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert report["trajectory"]["scale"] == pytest.approx(1 / SCALE)
    assert report["trajectory"]["frames_tracked"] == report["trajectory"]["frames"] == N
    assert report["depth"] == {
        "abs_rel": pytest.approx(0, abs=1e-6),
        "inlier_ratio": 1.0,
        "completeness": 1.0,
        "scale_ratio": pytest.approx(1.0),
    }
    assert report["map"]["splats"] == 1200
    assert report["time"]["stages"]["tracker"] == {"flow": 1.5}
    assert report["time"]["wall"] > 0
    assert report["memory"]["peak_bytes"]["tracker"] == 5
    assert report["skipped"] == {"tracker": {"frames": 2}}
    assert report["warnings"]["tracker"] == ["w"]


def test_files(evaluator: Evaluator) -> None:
    _feed(evaluator)
    assert evaluator.folder is not None
    assert {p.name for p in evaluator.folder.iterdir()} == {
        "report.json",
        "report.html",
        "comparison.png",
        "trajectory.txt",
    }
    html = (evaluator.folder / "report.html").read_text()
    assert html.count("data:image/jpeg;base64,") >= 12
    assert "http://" not in html  # nothing is fetched
    assert "https://" not in html
    assert len((evaluator.folder / "trajectory.txt").read_text().splitlines()) == N + 1


def test_lost_frames_have_no_pose_and_are_not_scored(evaluator: Evaluator) -> None:
    report = _feed(evaluator, lost=(4, 5))
    assert report["trajectory"]["frames_tracked"] == N - 2
    assert report["rendering"]["all"]["count"] == N - 2
    assert report["rendering"]["held_out"]["count"] == 1


def test_frames_are_rendered_with_the_focal_length_that_the_tracker_found(evaluator: Evaluator) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, 1.25)))
    list(evaluator.on_splat_map(_splat_map(True)))
    for view in evaluator.evaluation.views():
        np.testing.assert_array_equal(view.intrinsics, INTRINSICS * [1.25, 1.25, 1.0, 1.0])
    evaluator.evaluation.close()


def test_renders_are_rolled_with_the_shutter_that_the_tracker_took_out(evaluator: Evaluator) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    track = Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, readout=0.02)
    list(evaluator.on_trajectory(track))
    list(evaluator.on_splat_map(_splat_map(True)))
    finished, view = evaluator.evaluation.maps[True], evaluator.evaluation.views()[5]
    assert view.shutter is not None
    assert view.shutter.readout == 0.02
    moved = geometry.se3_log(geometry.inverse(poses[4]) @ poses[6])
    np.testing.assert_allclose(view.shutter.velocity, moved * 15, atol=1e-7)
    color, _ = render_view(finished.splats, finished.density, view, (H, W))
    still, _ = render_view(finished.splats, finished.density, replace(view, shutter=None), (H, W))
    assert np.abs(color - still).max() > 1e-3
    list(evaluator.on_end())
    assert "20.0 ms a frame" in evaluator.report["protocol"]


def test_frames_between_keyframes_are_rendered_at_an_exposure_between_theirs(evaluator: Evaluator) -> None:
    poses, index, none = _poses(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none)))
    splat_map = _splat_map(True)
    splat_map.exposures[1, :, :3] *= 0.5  # of frame 3; those of frames 0 and 6 are the identity
    list(evaluator.on_splat_map(splat_map))
    finished, views = evaluator.evaluation.maps[True], evaluator.evaluation.views()
    for frame, gain in ((0, 1.0), (2, 2 / 3), (3, 0.5), (5, 5 / 6), (6, 1.0)):
        view = views[frame]
        color, _ = render_view(finished.splats, finished.density, view, (H, W))
        plain, _ = render_view(finished.splats, finished.density, replace(view, exposure=None), (H, W))
        np.testing.assert_allclose(color, gain * plain, atol=1e-5)
    list(evaluator.on_end())
    assert "interpolated in time" in evaluator.report["protocol"]


def test_without_truth_the_figures_are_null(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    for k in range(N):
        image = np.full((H, W, 3), 128, np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = _feed(node)
    assert report["trajectory"]["ate_rmse"] is None
    assert report["depth"]["abs_rel"] is None
    assert any("no true poses" in note for note in report["notes"])
    assert report["rendering"]["keyframes"]["psnr"] is not None


def test_a_run_that_never_made_a_map_still_reports(tmp_path: Path) -> None:
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    list(node.on_end())
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["rendering"]["all"] == {"psnr": None, "ssim": None, "lpips": None, "count": 0}
    assert report["map"]["splats"] == 0
    assert any("no trajectory" in note for note in report["notes"])


def test_missing_lpips_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="set MVSGS_WEIGHTS to the folder"):
        Evaluator(Evaluator.Config(lpips="on"))
    node = Evaluator(Evaluator.Config(lpips="auto"))
    assert any("LPIPS is left out" in w for w in node.stats.warnings)
    node.evaluation.close()
