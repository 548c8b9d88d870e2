"""Keyframe graphs of known poses and depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import (
    Graph,
    reproject,
)


def scene(k: int = 4, m: int = 60, seed: int = 0, noise: float = 0.0) -> tuple[Graph, np.ndarray, np.ndarray]:
    """A graph whose targets are exact (plus noise), its true poses and its true inverse depths."""
    random = np.random.default_rng(seed)
    poses = geometry.se3_exp(random.normal(0.0, 0.08, (k, 6)))
    poses[0] = np.eye(4)
    inverse_depth = random.uniform(0.4, 1.6, (k, m))
    pixels = random.uniform([[20.0], [20.0]], [[300.0], [220.0]], (k, 2, m))
    intrinsics = np.array([260.0, 250.0, 159.5, 119.5])
    source, to = np.array([(i, j) for i in range(k) for j in range(k) if i != j]).T
    target, z = reproject(poses, inverse_depth, pixels, intrinsics, source, to)
    root = random.normal(0.0, 0.7, (len(source), m, 2, 2))
    tensor = root @ root.swapaxes(-1, -2) + 0.2 * np.eye(2)
    information = np.stack([tensor[..., 0, 0], tensor[..., 0, 1], tensor[..., 1, 1]], axis=1) * (z > 0.3)[:, None]
    graph = Graph(
        cam_from_world=poses.copy(),
        inverse_depth=inverse_depth.copy(),
        pixels=pixels,
        intrinsics=intrinsics,
        source=source,
        to=to,
        target=target + random.normal(0.0, noise, target.shape) if noise else target,
        information=information,
        free_pose=np.arange(k) > 0,
        free_depth=np.ones(k, bool),
    )
    return graph, poses, inverse_depth


def moved(graph: Graph, seed: int, pose: float, depth: float) -> Graph:
    random = np.random.default_rng(seed)
    step = geometry.se3_exp(random.normal(0.0, pose, (len(graph.cam_from_world), 6)) * graph.free_pose[:, None])
    factor = np.exp(random.normal(0.0, depth, graph.inverse_depth.shape))
    return replace(graph, cam_from_world=step @ graph.cam_from_world, inverse_depth=graph.inverse_depth * factor)


def noisy(k: int = 5, m: int = 61) -> Graph:
    return moved(scene(k=k, m=m, noise=0.5)[0], 1, 0.01, 0.05)
