"""What the evaluator renders of each frame: its pose, exposure and shutter; what is fitted to it, and what is not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msgs import FusedKeyframe, GroundTruth, Trajectory
from mvsgs_core import geometry
from mvsgs_core.datasets.lens import Lens, Undistortion
from mvsgs_core.evaluation.scoring import render_frame
from mvsgs_core.photometry import vignetting_factor
from nodes.evaluator import Evaluator
from tests.support.evaluated_wall import (
    INTRINSICS,
    ORIGIN,
    H,
    N,
    W,
    feed,
    poses_along,
    splat_map_of,
    wall_evaluator,
)


@pytest.fixture
def evaluator(tmp_path: Path) -> Evaluator:
    return wall_evaluator(tmp_path)


def test_frames_are_rendered_with_the_focal_length_that_the_tracker_found(evaluator: Evaluator) -> None:
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, 1.25)))
    list(evaluator.on_splat_map(splat_map_of(True)))
    for view in evaluator.evaluation.scored_frames():
        np.testing.assert_array_equal(view.intrinsics, INTRINSICS * [1.25, 1.25, 1.0, 1.0])
    evaluator.evaluation.close()


def test_renders_are_as_the_rolling_shutter_saw_them(evaluator: Evaluator) -> None:
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    track = Trajectory(index, index / 30, poses, index < 0, none.astype(np.uint8), none, readout_time=0.02)
    list(evaluator.on_trajectory(track))
    list(evaluator.on_splat_map(splat_map_of(True)))
    finished, view = evaluator.evaluation.maps[True], evaluator.evaluation.scored_frames()[5]
    assert view.readout is not None
    moved = geometry.se3_log(geometry.inverse(poses[4]) @ poses[6])
    np.testing.assert_allclose(view.readout, moved * 15 * 0.02, atol=1e-9)
    color = render_frame(finished.splats, finished.kernel, view, (H, W)).color
    still = render_frame(finished.splats, finished.kernel, replace(view, readout=None), (H, W)).color
    assert np.abs(color - still).max() > 1e-3
    list(evaluator.on_trajectory(replace(track, reads_columns=True)))
    upright = render_frame(finished.splats, finished.kernel, evaluator.evaluation.scored_frames()[5], (H, W)).color
    assert min(np.abs(upright - color).max(), np.abs(upright - still).max()) > 1e-3
    given = np.arange(6.0) * np.ones((N, 1))
    list(evaluator.on_trajectory(replace(track, velocity=given)))  # the tracker knows better
    np.testing.assert_allclose(evaluator.evaluation.scored_frames()[5].readout, 0.02 * given[5])
    list(evaluator.on_end())
    assert "20.0 ms a frame" in evaluator.report["protocol"]


def test_frames_are_rendered_at_the_trackers_exposure_and_vignetting(evaluator: Evaluator, tmp_path: Path) -> None:
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    gains = np.ones(N)
    gains[[2, 3, 5]] = 0.2, 0.5, 0.7
    exposure = (gains[:, None, None] * np.eye(3, 4)).astype(np.float32)
    vignetting = np.array([-0.3, 0.0, 0.0], np.float32)
    state = none.astype(np.uint8)
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index % 3 == 0, state, none, exposure=exposure)))
    splat_map = replace(splat_map_of(True), vignetting=vignetting)
    splat_map.exposures[1, :, :3] *= 0.5  # of frame 3; those of frames 0 and 6 are the identity
    list(evaluator.on_splat_map(splat_map))
    finished, views = evaluator.evaluation.maps[True], evaluator.evaluation.scored_frames()
    factor = vignetting_factor(vignetting, INTRINSICS, (H, W))[..., None]
    for frame in (0, 2, 3, 5, 6):
        view = views[frame]
        bare = replace(view, exposure=None, vignetting=None)
        color, plain = (render_frame(finished.splats, finished.kernel, v, (H, W)).color for v in (view, bare))
        np.testing.assert_allclose(color, gains[frame] * plain * factor, atol=1e-5)
    list(evaluator.on_end())
    assert "each frame's exposure and its vignetting as the tracker estimated" in evaluator.report["protocol"]
    report = json.loads((tmp_path / "report.json").read_text())["exposure"]
    assert report["keyframes"] == list(range(0, N, 3))
    np.testing.assert_allclose(report["gain"][:3], [[1.0] * 3, [0.5] * 3, [1.0] * 3])
    np.testing.assert_allclose(report["vignetting"], vignetting)
    assert "Exposure by frame" in (tmp_path / "report.html").read_text()


def test_a_photograph_in_any_order_has_the_exposure_of_the_nearest_one(evaluator: Evaluator) -> None:
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    poses[:, :3, 3] += ORIGIN
    poses[4] = poses[0]
    gains = np.ones(N)
    gains[[3, 5]] = 0.5, 0.7
    exposure = (gains[:, None, None] * np.eye(3, 4)).astype(np.float32)
    exposure[4] = np.nan
    track = Trajectory(
        index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none, exposure=exposure, in_order=False
    )
    list(evaluator.on_trajectory(track))
    splat_map = splat_map_of(True)
    splat_map.exposures[1, :, :3] *= 0.5  # of frame 3
    list(evaluator.on_splat_map(splat_map))
    found = evaluator.evaluation.scored_frames()[4].exposure
    assert found is not None
    np.testing.assert_allclose(found, np.eye(3, 4), atol=1e-6)
    evaluator.evaluation.close()


def test_without_exposures_the_report_speaks_of_none(evaluator: Evaluator, tmp_path: Path) -> None:
    report = feed(evaluator)
    assert report["exposure"] is None
    assert "tracker estimated" not in report["protocol"]
    assert "Exposure by frame" not in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("fitted", [True, False])
def test_held_out_frames_are_scored_by_both_protocols(tmp_path: Path, fitted: bool) -> None:
    """Photographs that the map shows but for their exposure; the strict figure is the same with and without fitting."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off", fitted=fitted))
    for k in range(N):
        image = np.full((H, W, 3), (150, 40, 45), np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    report = feed(node)
    after = report["rendering"]
    assert after["held_out"]["psnr"] == pytest.approx(18.18, abs=0.01)
    assert report["rendering_before_refinement"]["held_out_fitted"]["count"] == 0
    assert all((frame["fitted"] is not None) == (fitted and frame["held_out"]) for frame in after["frames"])
    assert ("held-out, fitted" in (tmp_path / "report.html").read_text()) == fitted
    assert ("ARTDECO" in report["protocol"]) == fitted
    assert (report["time"]["stages"]["evaluator"]["fitting at test time"] > 0) == fitted
    assert after["held_out_fitted"]["count"] == 2 * fitted
    assert not fitted or after["held_out_fitted"]["psnr"] > 40


def test_frames_and_the_written_trajectory_follow_the_poses_that_the_map_found(evaluator: Evaluator) -> None:
    splat_map, poses = splat_map_of(True), poses_along()
    splat_map.world_from_cam[:, 1, 3] += 0.05
    poses[:, :3, 3] += ORIGIN
    index, none = np.arange(N), np.zeros(N, np.int32)
    list(evaluator.on_trajectory(Trajectory(index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none)))
    list(evaluator.on_splat_map(splat_map))
    for view in evaluator.evaluation.scored_frames():
        expected = poses[view.index, :3, 3] + [0.0, 0.05, 0.0] - ORIGIN
        np.testing.assert_allclose(view.world_from_cam[:3, 3], expected, atol=1e-8)
    list(evaluator.on_end())
    assert evaluator.folder is not None
    written = np.loadtxt(evaluator.folder / "trajectory.txt")
    np.testing.assert_allclose(written[:, 2], poses[:, 1, 3] + 0.05, atol=1e-5)


def test_where_tracking_was_lost_all_figures_are_of_the_part_that_the_map_shows(tmp_path: Path) -> None:
    """Of two parts of six frames the second has more keyframes; the first lies 100 units away."""
    node, splat_map, poses, index = wall_evaluator(tmp_path), splat_map_of(True), poses_along(), np.arange(N)
    poses[7:10, :3, 3] += 0.4 * np.eye(3)  # not along a line: so GPS tells how they are turned
    x, y, z = 50.0 * poses[:, :3, 3].T
    degree = np.radians(1.0) * 6378137.0
    poses[:, :3, 3] += ORIGIN
    poses[:6, :3, 3] += 100.0
    shown = replace(
        splat_map, keyframes=np.array([6, 9]), world_from_cam=poses[[6, 9]], scale=np.ones(2),
        exposures=splat_map.exposures[:2],
    )  # fmt: skip
    track = Trajectory(
        index, index / 30, poses, np.isin(index, [0, 6, 9]), np.zeros(N, np.uint8), (index > 5).astype(np.int32),
        places=np.stack([z / degree + 1e-7, x / degree, -y], axis=1),
    )  # fmt: skip
    list(node.on_trajectory(track))
    list(node.on_splat_map(shown))
    list(node.on_end())
    assert [frame["index"] for frame in node.report["rendering"]["frames"]] == list(range(6, N))
    assert node.report["rendering"]["all"]["psnr"] > 35
    assert node.report["trajectory"]["ate_frames"] == node.report["georeference"]["positions"] == 6
    np.testing.assert_allclose(np.loadtxt(tmp_path / "trajectory.txt")[:, 0], index[6:] / 30, atol=1e-6)
    assert any(warning.startswith("6 of 12 frames with a pose are of parts that") for warning in node.stats.warnings)
    path = node.evaluation.aligned_path()
    assert path is not None
    assert path.index.tolist() == list(range(6, N))


@pytest.mark.parametrize("bent", [False, True], ids=["as it came", "once straightened"])
def test_a_frame_whose_mask_leaves_nothing_is_not_scored(tmp_path: Path, bent: bool) -> None:
    """Frame 4, and keyframe 3, whose own image would stand in for it. bent: their masks leave a corner, which is
    outside of the image without the distortion."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    node.evaluation.given = {"lpips": lambda a, b: 0.5}
    image, whole, nothing = np.zeros((H, W, 3), np.uint8), np.ones((H, W), bool), np.zeros((H, W), bool)
    nothing[0, 0] = bent
    lens = Undistortion(Lens((30.0, 30.0, 15.5, 11.5), (H, W), (-0.4, 0.1, 0.0, 0.0)))
    assert not lens.mask(nothing).any()
    for k in range(N):
        mask = nothing if k in (3, 4) else whole
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None, mask=mask)))
    depth = np.zeros((H // 2, W // 2), np.float32)
    own = FusedKeyframe(3, 0.1, image, INTRINSICS, np.eye(4), 1.0, depth, depth, np.zeros((*depth.shape, 3), "f4"), 0)
    list(node.on_fused_keyframe(replace(own, mask=nothing)))
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    track = Trajectory(index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none)
    list(node.on_trajectory(replace(track, distortion=np.array([-0.4, 0.1])) if bent else track))
    list(node.on_splat_map(splat_map_of(True)))
    list(node.on_end())
    assert [frame["index"] for frame in node.report["rendering"]["frames"]] == [0, 1, 2, *range(5, N)]
    assert node.report["rendering"]["all"]["psnr"] is not None


def test_true_depth_is_compared_without_the_distortion_that_was_found(evaluator: Evaluator) -> None:
    """A keyframe's depth is that of its image, which has none."""
    lens = Undistortion(Lens((30.0, 30.0, 15.5, 11.5), (H, W), (-0.4, 0.1, 0.0, 0.0)))
    v, u = np.mgrid[:H, :W]
    truth, image = (2.0 + 0.1 * u + 0.05 * v).astype(np.float32), np.zeros((H, W, 3), np.uint8)
    list(evaluator.on_ground_truth(GroundTruth(3, 0.1, image, INTRINSICS, None, truth)))
    straight = lens.depth(truth)
    assert np.abs(straight / truth - 1.0).max() > 0.05
    poses, index, none = poses_along(), np.arange(N), np.zeros(N, np.int32)
    normals = np.zeros((H, W, 3), np.float32)
    view = FusedKeyframe(3, 0.1, image, INTRINSICS, poses[3], 1.0, straight, np.ones_like(straight), normals, 0)
    list(evaluator.on_fused_keyframe(view))
    track = Trajectory(index, index / 30, poses, index % 3 == 0, none.astype(np.uint8), none)
    list(evaluator.on_trajectory(replace(track, distortion=np.array([-0.4, 0.1]))))
    list(evaluator.on_splat_map(splat_map_of(True)))
    list(evaluator.on_end())
    depth = evaluator.report["depth"]
    assert depth["abs_rel"] == pytest.approx(0.0, abs=1e-6)
    assert depth["completeness"] == 1.0
