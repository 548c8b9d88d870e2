"""A run past a wall of splats, as the evaluator gets it: frames, trajectory, a keyframe, the map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from msgs import FusedKeyframe, GroundTruth, SplatMap, TrackingState, Trajectory
from mvsgs_core import geometry
from nodes.evaluator import Evaluator

H, W, N, SCALE = 24, 32, 12, 0.5  # the estimate's unit is 2 true units
INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])
ORIGIN = np.array([1e6, -2e6, 3e6])


def poses_along() -> np.ndarray:
    poses = np.tile(np.eye(4), (N, 1, 1))
    for k in range(N):
        poses[k] = geometry.se3_exp(np.array([0.1 * k, 0.03 * np.sin(k), 0.02 * k, 0, 0.01 * k, 0]))
    return poses


def splat_map_of(refined: bool) -> SplatMap:
    """A wall of splats 2 units in front of the cameras, redder after the refinement."""
    x, y = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 30))
    n = x.size
    keyframes = np.arange(0, N, 3)
    world_from_cam = poses_along()[keyframes]
    world_from_cam[:, :3, 3] += ORIGIN
    return SplatMap(
        refined=refined,
        iterations=100,
        kernel="gaussian",
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


def wall_evaluator(tmp_path: Path) -> Evaluator:
    """It has got the frames and the true poses."""
    node = Evaluator(Evaluator.Config(output=str(tmp_path), lpips="off"))
    poses = poses_along()
    for k in range(N):
        true_pose = poses[k].copy()
        true_pose[:3, 3] *= 1 / SCALE
        image = np.full((H, W, 3), (204, 51, 51), np.uint8)
        depth = np.full((H, W), 4.0, np.float32)
        assert not list(node.on_ground_truth(GroundTruth(k, k / 30, image, INTRINSICS, true_pose, depth)))
    return node


def feed(
    node: Evaluator, lost: tuple[int, ...] = (), upstream: dict[str, Any] | None = None,
    places: np.ndarray | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Sends it the rest, frames with `places` (N, 3) by GPS; returns report.json."""
    world_from_cam = poses_along()
    world_from_cam[:, :3, 3] += ORIGIN
    state = np.zeros(N, np.uint8)
    for k in lost:
        state[k], world_from_cam[k] = TrackingState.LOST, np.nan
    index = np.arange(N)
    keyframe = (index % 3 == 0) & (state == 0)
    segment = np.zeros(N, np.int32)
    list(node.on_trajectory(Trajectory(index, index / 30, world_from_cam, keyframe, state, segment, places=places)))
    depth = np.full((H // 2, W // 2), 2.0, np.float32)
    image = np.zeros((H, W, 3), np.uint8)
    normals = np.zeros((H // 2, W // 2, 3), np.float32)
    view = FusedKeyframe(3, 0.1, image, INTRINSICS, world_from_cam[3], 1.0, depth, np.ones_like(depth), normals, 0)
    list(node.on_fused_keyframe(view))
    for refined in (False, True):
        list(node.on_splat_map(splat_map_of(refined)))
    node.upstream |= upstream or {
        "tracker": {"seconds": {"flow": 1.5}, "peak_bytes": 5, "skipped": {"frames": 2}, "warnings": ["w"]}
    }
    list(node.on_end())
    assert node.folder is not None
    report: dict[str, Any] = json.loads((node.folder / "report.json").read_text())
    return report
