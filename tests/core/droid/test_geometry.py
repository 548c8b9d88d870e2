"""Reprojection, frame distance and the depth filter against the authors' values (golden, its README)."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core import geometry
from mvsgs_core.droid.geometry import agreeing_neighbors, frame_distance, reproject
from tests.support.golden import error, folder

TOLERANCE = 1e-5


class Scene:
    def __init__(self, name: str) -> None:
        stored, self.golden = np.load(folder("droid") / "ba.npz"), np.load(folder("droid") / "geometry.npz")
        poses = np.tile(np.eye(4), (len(stored[f"{name}_poses"]), 1, 1))
        quaternions = stored[f"{name}_poses"][:, [6, 3, 4, 5]].astype(np.float64)
        poses[:, :3, :3] = geometry.rotation_from_quaternion(quaternions)
        poses[:, :3, 3] = stored[f"{name}_poses"][:, :3]
        self.poses = torch.from_numpy(poses)
        self.inverse_depth = torch.from_numpy(stored[f"{name}_disps"]).double()
        self.intrinsics = torch.from_numpy(stored[f"{name}_intrinsics"]).double()
        self.i, self.j = stored[f"{name}_ii"], stored[f"{name}_jj"]

    def relative(self, i: np.ndarray, j: np.ndarray) -> torch.Tensor:
        return self.poses[j] @ torch.linalg.inv(self.poses[i])


@pytest.fixture(params=["A", "B"])
def named(request: pytest.FixtureRequest) -> tuple[str, Scene]:
    return request.param, Scene(request.param)


def test_reprojection(named: tuple[str, Scene]) -> None:
    name, scene = named
    coords, valid = reproject(scene.relative(scene.i, scene.j), scene.inverse_depth[scene.i], scene.intrinsics)
    assert error(coords, scene.golden[f"{name}_reproject_coords"]) < TOLERANCE
    np.testing.assert_array_equal(valid, scene.golden[f"{name}_reproject_valid"] > 0)


def test_frame_distance(named: tuple[str, Scene]) -> None:
    name, scene = named
    k = len(scene.poses)
    i, j = np.repeat(np.arange(k), k), np.tile(np.arange(k), k)
    found = frame_distance(scene.relative(i, j), scene.inverse_depth[i], scene.intrinsics, 0.3).reshape(k, k)
    stored = scene.golden[f"{name}_frame_distance_beta0.3"]
    other = ~np.eye(k, dtype=bool)  # the diagonal is rounding noise
    assert error(found.numpy()[other], stored[other]) < TOLERANCE


def test_depth_filter(named: tuple[str, Scene]) -> None:
    """With the authors' neighbors: three before, and three that begin at the third after."""
    name, scene = named
    k = len(scene.poses)
    for i in range(k):
        others = np.array([n for n in (i - 1, i - 2, i - 3, i + 3, i + 4, i + 5) if 0 <= n < k])
        relative = scene.relative(np.full(len(others), i), others)
        maps = scene.inverse_depth
        count = agreeing_neighbors(relative, maps[i], maps[others], scene.intrinsics, 0.25)
        np.testing.assert_array_equal(count, scene.golden[f"{name}_depth_filter_count"][i])


def test_a_point_behind_the_target_is_not_valid() -> None:
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))[None]
    intrinsics = torch.tensor([8.0, 8.0, 3.5, 3.5], dtype=torch.float64)
    coords, valid = reproject(turned, torch.ones(1, 8, 8, dtype=torch.float64), intrinsics)
    assert torch.isfinite(coords).all()
    assert not valid.any()
    distance = frame_distance(turned, torch.ones(1, 8, 8, dtype=torch.float64), intrinsics, 0.3)
    assert distance.item() == 1000.0
