"""Dense bundle adjustment against the published equations (golden), finite differences, and known scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.bundle_adjustment import DROID_GLOBAL, DROID_LOCAL, Graph, adjust
from tests.shared_data import shared

CASES = {
    # first free pose, solver, poses only, depth prior
    "a": ("A", 1, replace(DROID_LOCAL, steps=1), False, False),
    "b": ("A", 1, DROID_LOCAL, False, False),
    "c": ("A", 2, DROID_LOCAL, False, False),
    "d": ("A", 1, DROID_GLOBAL, False, False),
    "e": ("A", 1, DROID_LOCAL, True, False),
    "f": ("A", 1, DROID_LOCAL, False, True),
    "g": ("B", 1, DROID_LOCAL, False, False),
}


def matrices(poses: np.ndarray) -> np.ndarray:
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    quaternions = poses[:, [6, 3, 4, 5]].astype(np.float64)
    result[:, :3, :3] = geometry.rotation_from_quaternion(quaternions)
    result[:, :3, 3] = poses[:, :3]
    return result


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_droid_slams_equations(case: str) -> None:
    golden = np.load(shared("golden/droid") / "ba.npz")
    scene, first_free, solver, poses_only, with_prior = CASES[case]
    disps = golden[f"{scene}_disps"].astype(np.float64)
    k, h, w = disps.shape
    m = h * w
    v, u = np.mgrid[:h, :w].astype(np.float64)
    eta = golden[f"{scene}_eta"].astype(np.float64).reshape(k, m)
    sensed = golden[f"{scene}_disps_sens"].astype(np.float64).reshape(k, m)
    has_prior = with_prior & (sensed > 0)
    graph = Graph(
        cam_from_world=matrices(golden[f"{scene}_poses"]),
        inverse_depth=disps.reshape(k, m),
        pixels=np.tile(np.stack([u.ravel(), v.ravel()]), (k, 1, 1)),
        intrinsics=golden[f"{scene}_intrinsics"].astype(np.float64),
        source=golden[f"{scene}_ii"],
        to=golden[f"{scene}_jj"],
        target=golden[f"{scene}_target"].reshape(-1, 2, m).astype(np.float64),
        information=0.001 * golden[f"{scene}_weight"].reshape(-1, 2, m).astype(np.float64),
        free_pose=np.arange(k) >= first_free,
        free_depth=np.full(k, not poses_only),
        damping=np.where(has_prior, 0.0, eta) if with_prior else eta,
        prior=sensed if with_prior else None,
        prior_weight=np.where(has_prior, 0.05, 0.0) if with_prior else None,
    )
    solution = adjust(graph, solver)
    assert not solution.failure
    poses, disparities = (f"{case}_poses", None) if poses_only else (f"{case}_full_poses", f"{case}_full_disps")
    np.testing.assert_allclose(solution.cam_from_world, matrices(golden[poses]), atol=1e-8)
    if disparities:
        np.testing.assert_allclose(solution.inverse_depth.reshape(k, h, w), golden[disparities], atol=1e-8)
