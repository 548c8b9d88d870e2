"""Whose poses the evaluator scores by: the tracker's, whatever that says of keyframes, or else the map's own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launch.summary import _figures
from msgs import FusedKeyframe, GroundTruth, Trajectory
from mvsgs_core.rasterizer.interface import as_bytes
from nodes.evaluator import Evaluator
from nodes.splat_map import snapshot_of
from tests.support.evaluated_wall import INTRINSICS, ORIGIN, SCALE, H, N, W, poses_along, splat_map_of, wall_evaluator

INDEX = np.arange(N)


def track(keyframe: np.ndarray) -> Trajectory:
    poses = poses_along()
    poses[:, :3, 3] += ORIGIN
    return Trajectory(INDEX, INDEX / 30, poses, keyframe, np.zeros(N, np.uint8), np.zeros(N, np.int32))


def ended(node: Evaluator) -> dict[str, Any]:
    list(node.on_end())
    assert node.folder is not None
    report: dict[str, Any] = json.loads((node.folder / "report.json").read_text())
    return report


def test_where_no_frame_is_a_keyframe_all_frames_are_aligned(tmp_path: Path) -> None:
    """As where a stream is only localized in a map that another one made."""
    node, made = wall_evaluator(tmp_path), splat_map_of(True)
    list(node.on_trajectory(track(np.zeros(N, bool))))
    list(node.on_splat_map(replace(made, keyframes=made.keyframes - 1_000_000_000)))
    report = ended(node)
    found = report["trajectory"]
    assert found["ate_rmse"] is None
    assert found["ate_percent"] is None
    assert found["ate_rmse_frames"] == pytest.approx(0.0, abs=1e-6)
    assert found["rpe_translation"] == pytest.approx(0.0, abs=1e-6)
    assert found["rpe_rotation"] == pytest.approx(0.0, abs=1e-4)
    assert found["scale"] == pytest.approx(1 / SCALE)
    assert "ATE: all frames are aligned (Sim(3)), as fewer than 3 keyframes have a true pose" in report["protocol"]
    (line,) = [line for line in _figures(report) if line.startswith("trajectory")]
    assert line.endswith(f"ATE of all 0.0000 (RMSE of {N} frames, in the true poses' unit)")


def test_what_the_map_is_made_of_is_not_held_out(tmp_path: Path) -> None:
    """A tracker of a user's own, which does not say in its trajectory that it made keyframes of frames 5 and 10."""
    node, made = wall_evaluator(tmp_path), splat_map_of(True)
    keyframes = np.array([0, 3, 5, 10])
    poses = poses_along()[keyframes]
    poses[:, :3, 3] += ORIGIN
    list(node.on_trajectory(track(np.isin(INDEX, [0, 3]))))
    list(node.on_splat_map(replace(made, keyframes=keyframes, world_from_cam=poses)))
    report = ended(node)
    assert report["rendering"]["held_out"]["count"] == 0
    assert report["rendering"]["keyframes"]["count"] == report["trajectory"]["keyframes"] == 4
    assert report["trajectory"]["held_out_keyframes"] == [5, 10]
    assert "2 keyframes of the map are none in the tracker's Trajectory: they count as keyframes" in report["notes"]


def test_without_a_trajectory_the_keyframes_of_the_map_are_scored(tmp_path: Path) -> None:
    """A tracker of a user's own, which sends no Trajectory."""
    node = wall_evaluator(tmp_path)
    (tmp_path / "trajectory.txt").write_text("of the mapper\n")
    for refined in (False, True):
        list(node.on_splat_map(splat_map_of(refined)))
    report = ended(node)
    assert report["rendering"]["keyframes"]["count"] == report["trajectory"]["keyframes"] == 4
    assert report["rendering"]["keyframes"]["psnr"] > 35
    assert report["rendering"]["all"]["count"] == 4
    assert report["trajectory"]["frames"] == N
    assert report["trajectory"]["ate_rmse"] == pytest.approx(0.0, abs=1e-6)
    assert report["run"]["stream_seconds"] is None
    assert "no trajectory was received: the map's keyframes are scored, and no other frame" in report["notes"]
    assert not any("empty map" in note for note in report["notes"])
    assert (tmp_path / "trajectory.txt").read_text() == "of the mapper\n"


def test_without_a_trajectory_a_map_of_another_stream_leaves_nothing_to_score(tmp_path: Path) -> None:
    node, made = wall_evaluator(tmp_path), splat_map_of(True)
    list(node.on_splat_map(replace(made, keyframes=made.keyframes - 1_000_000_000)))
    report = ended(node)
    assert report["rendering"]["all"]["count"] == report["trajectory"]["keyframes"] == 0
    assert report["trajectory"]["ate_rmse_frames"] is None


def test_frames_that_never_reached_the_tracker_are_said(tmp_path: Path) -> None:
    node = wall_evaluator(tmp_path)
    for k in (N, N + 1, N + 1):  # the last came twice
        image = np.zeros((H, W, 3), np.uint8)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, None, None)))
    list(node.on_trajectory(track(INDEX % 3 == 0)))
    list(node.on_splat_map(splat_map_of(True)))
    assert f"2 of {N + 2} frames are not in the tracker's Trajectory: no figure is of them" in ended(node)["notes"]


def textured_wall_report(folder: Path, trajectory: Trajectory | None, views: np.ndarray) -> dict[str, Any]:
    """Of a stream whose camera is taken for a wider one; `views` are those keyframes that come as they were mapped."""
    made, given = splat_map_of(True), INTRINSICS * [0.7, 0.7, 1, 1]
    colors = np.random.default_rng(3).uniform(-1.5, 1.5, made.sh.shape).astype(np.float32)
    made = replace(made, sh=colors)
    poses, finished = poses_along(), snapshot_of(made)
    node = Evaluator(Evaluator.Config(output=str(folder), lpips="off"))
    depth, normals = np.full((H, W), 2.0, np.float32), np.zeros((H, W, 3), np.float32)
    for k in range(N):
        pose = poses[k].copy()
        pose[:3, 3] += ORIGIN
        image = as_bytes(finished.render(pose, INTRINSICS, (H, W)).color)
        list(node.on_ground_truth(GroundTruth(k, k / 30, image, given, None, None)))
        if k in views:
            seen = FusedKeyframe(k, k / 30, image, INTRINSICS, pose, 1.0, depth, np.ones_like(depth), normals, 0)
            list(node.on_fused_keyframe(seen))
    if trajectory is not None:
        list(node.on_trajectory(trajectory))
    list(node.on_splat_map(made))
    return ended(node)


def test_without_a_trajectory_keyframes_are_scored_as_they_were_mapped(tmp_path: Path) -> None:
    keyframes = splat_map_of(True).keyframes
    known = replace(track(np.isin(INDEX, keyframes)), focal_factor=1 / 0.7)
    with_one = textured_wall_report(tmp_path / "a", known, keyframes)["rendering"]["keyframes"]
    report = textured_wall_report(tmp_path / "b", None, keyframes)
    assert report["rendering"]["keyframes"]["count"] == with_one["count"] == len(keyframes)
    assert report["rendering"]["keyframes"]["psnr"] == pytest.approx(with_one["psnr"], abs=0.01)
    assert with_one["psnr"] > 40
    assert not any("as they came" in note for note in report["notes"])
    report = textured_wall_report(tmp_path / "c", None, keyframes[1:])
    assert report["rendering"]["keyframes"]["psnr"] < with_one["psnr"] - 3
    assert "1 of 4 keyframes were not received as they were mapped: they are scored as they came" in report["notes"]
