"""A map of the tiny scene as the mapper would leave it, far from the origin, for what is written to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mvsgs_core.export.cameras import Cameras, write_cameras
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.insertion import InsertionConfig, points_from_depth, splats_from_points
from mvsgs_core.trajectory_file import write_trajectory
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

ORIGIN = np.array([10.0, -3.0, 0.5])
SIZE = (24, 32)
INTRINSICS = np.array([25.0, 26.0, 15.5, 11.5])


def final_map(bases: int = 4, kernel: str = "gaussian", origin: np.ndarray = ORIGIN, size: tuple[int, int] = SIZE,
              opacity: float = 0.9) -> Snapshot:  # fmt: skip
    """A splat for each pixel of the view from the origin."""
    view = rgbd_keyframe(0, np.eye(4), size)
    points = points_from_depth(view.depth, view.intrinsics, view.image / 255.0, view.normals, np.ones(size, dtype=bool))
    splats = splats_from_points(points, np.eye(4), bases, kernel, InsertionConfig(initial_opacity=opacity))
    generator = torch.Generator().manual_seed(0)
    splats.sh[:, 1:] = 0.1 * torch.randn(splats.sh[:, 1:].shape, generator=generator)
    splats.betas = splats.betas + torch.rand(len(splats), generator=generator)
    return Snapshot(
        splats=splats, anchors=np.zeros(len(splats), dtype=np.int64), origin=origin, kernel=kernel, iterations=5,
        keyframes=np.zeros(1, dtype=np.int64), world_from_cam=np.eye(4)[None], scale=np.ones(1),
        exposures=np.eye(3, 4, dtype=np.float32)[None],
    )  # fmt: skip


def poses_around(times: list[float]) -> np.ndarray:
    poses = np.stack([pose_on_arc(t) for t in times])
    poses[:, :3, 3] += ORIGIN
    return poses


def cameras_around(times: list[float], size: tuple[int, int] = SIZE, intrinsics: np.ndarray = INTRINSICS) -> Cameras:
    """Keyframes 0, 7, 14 ..."""
    count = len(times)
    return Cameras(
        keyframes=7 * np.arange(count),
        timestamps=np.arange(count) / 3.0,
        world_from_cam=poses_around(times),
        intrinsics=np.tile(intrinsics, (count, 1)),
        sizes=np.tile(np.array(size), (count, 1)),
        exposures=np.tile(np.eye(3, 4), (count, 1, 1)),
    )


def save_cameras(folder: Path, times: list[float], size: tuple[int, int] = SIZE,
                 intrinsics: np.ndarray = INTRINSICS) -> Cameras:  # fmt: skip
    cameras = cameras_around(times, size, intrinsics)
    write_cameras(folder / "cameras.json", cameras)
    return cameras


def write_poses(path: Path, times: list[float]) -> np.ndarray:
    poses = poses_around(times)
    write_trajectory(path, np.arange(len(times), dtype=np.float64), poses)
    return poses


def write_tiny_run(folder: Path) -> Path:
    """The output folder of a run: map.ply, cameras.json, trajectory.txt."""
    folder.mkdir()
    times = [0.0, 0.5, 1.0]
    write_ply(folder / "map.ply", final_map())
    save_cameras(folder, times)
    write_poses(folder / "trajectory.txt", times)
    return folder
