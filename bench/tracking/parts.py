"""A part of the tracker measured alone: global bundle adjustment of a given size."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.back_end import BackEndConfig
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solver, adjust, reproject


def global_adjustment_seconds(keyframes: int, cells: int = 1200, edges: int = 12, seed: int = 0) -> float:
    """CPU seconds of the global bundle adjustment (all its robust scales) of a camera that goes around a room.

    edges: directed, of each keyframe. Two thirds of the cells are textured, matches are off by half a pixel.
    """
    random = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(keyframes) / keyframes
    turn = geometry.so3_exp(np.stack([0.0 * angle, angle, 0.0 * angle], axis=1))
    poses = np.tile(np.eye(4), (keyframes, 1, 1))
    poses[:, :3, :3] = turn.swapaxes(-1, -2)
    poses[:, :3, 3] = -(poses[:, :3, :3] @ np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)[..., None])[
        ..., 0
    ]
    intrinsics = np.array([256.0, 256.0, 159.5, 119.5])
    pixels = random.uniform([[0.0], [0.0]], [[319.0], [239.0]], (keyframes, 2, cells))
    inverse_depth = random.uniform(0.3, 1.0, (keyframes, cells))
    source = np.repeat(np.arange(keyframes), edges)
    offset = np.tile(np.concatenate([np.arange(1, edges // 2 + 1), -np.arange(1, edges // 2 + 1)]), keyframes)
    to = (source + offset) % keyframes
    target, z = reproject(poses, inverse_depth, pixels, intrinsics, source, to)
    inside = (z > 0.1) & (target[:, 0] > 0) & (target[:, 0] < 320) & (target[:, 1] > 0) & (target[:, 1] < 240)
    weight = inside & (random.random(inside.shape) < 0.66)
    free = np.arange(keyframes) > 0
    graph = Graph(
        cam_from_world=geometry.se3_exp(random.normal(0.0, 0.005, (keyframes, 6)) * free[:, None]) @ poses,
        inverse_depth=inverse_depth * np.exp(random.normal(0.0, 0.1, inverse_depth.shape)),
        pixels=pixels,
        intrinsics=intrinsics,
        source=source,
        to=to,
        target=target + random.normal(0.0, 0.5, target.shape),
        information=np.repeat(weight[:, None].astype(np.float64), 2, axis=1),
        free_pose=free,
        free_depth=np.ones(keyframes, bool),
    )
    config = BackEndConfig()
    start = time.process_time()
    for scale in config.robust_scales:
        solution = adjust(graph, Solver(steps=config.steps, robust_scale=scale, lm=1e-5))
        if solution.failure:
            raise RuntimeError(f"global bundle adjustment failed: {solution.failure}")
        graph = replace(graph, cam_from_world=solution.cam_from_world, inverse_depth=solution.inverse_depth)
    return time.process_time() - start
