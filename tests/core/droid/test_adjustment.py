"""SE(3) and dense bundle adjustment as DROID-SLAM's graph calls it, against golden (its README has the definitions).

The authors' kernel leaves the first free pose out of the depths' step, which we do not copy: our poses are theirs
where one step is made, our depths are theirs plus that term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.droid.adjustment import GLOBAL, LOCAL, solve
from mvsgs_core.droid.video import Video, VideoFrame
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from tests.support.golden import error, folder

EXACT, SINGLE = 1e-8, 1e-5
AMPLIFIED = 1e-7  # what 1e-8 in the poses' step makes of the depths'


@dataclass
class Factor:
    source: int
    to: int
    target: np.ndarray
    weight: np.ndarray


@pytest.fixture(scope="module")
def lie() -> dict[str, np.ndarray]:
    return {k: v.astype(np.float64) for k, v in np.load(folder("droid") / "geometry.npz").items()}


@pytest.fixture(scope="module")
def stored() -> dict[str, np.ndarray]:
    return dict(np.load(folder("droid") / "ba.npz"))


def matrices(poses: np.ndarray) -> np.ndarray:
    """(N, 4, 4) of (N, 7) translations and quaternions (x, y, z, w)."""
    made = np.tile(np.eye(4), (len(poses), 1, 1))
    made[:, :3, :3] = geometry.rotation_from_quaternion(poses[:, [6, 3, 4, 5]].astype(np.float64))
    made[:, :3, 3] = poses[:, :3]
    return made


def adjoint(pose: np.ndarray) -> np.ndarray:
    """(6, 6) that carries a twist (translation, rotation) through a pose."""
    made = np.kron(np.eye(2), pose[:3, :3])
    made[:3, 3:] = geometry.skew(pose[:3, 3]) @ pose[:3, :3]
    return made


def test_exponential_and_logarithm(lie: dict[str, np.ndarray]) -> None:
    ours = geometry.se3_exp(lie["xi"])
    assert error(ours, matrices(lie["se3_exp"])) < SINGLE
    assert error(ours, lie["se3_matrix"]) < SINGLE
    assert error(geometry.se3_log(ours), lie["se3_log"]) < SINGLE
    quaternions = geometry.quaternion_from_rotation(ours[:, :3, :3])[:, [1, 2, 3, 0]]
    theirs = lie["se3_exp"][:, 3:]
    assert error(quaternions * np.sign((quaternions * theirs).sum(axis=1, keepdims=True)), theirs) < SINGLE


def test_products_and_inverses(lie: dict[str, np.ndarray]) -> None:
    a, b = geometry.se3_exp(lie["xi"]), geometry.se3_exp(lie["xi2"])
    assert error(geometry.inverse(a), matrices(lie["se3_inv"])) < SINGLE
    assert error(a @ b, matrices(lie["se3_mul"])) < SINGLE
    assert error(a @ b, matrices(lie["se3_retr"])) < SINGLE  # a retraction moves from the left
    carried = np.stack([row @ adjoint(pose) for row, pose in zip(lie["row"], a)])
    assert error(carried, lie["se3_adjT_row"]) < SINGLE
    # the adjoint of this test is the one that belongs to our exponential
    np.testing.assert_allclose(a[0] @ b[0] @ geometry.inverse(a[0]), geometry.se3_exp(adjoint(a[0]) @ lie["xi2"][0]))


def run(stored: dict[str, np.ndarray], scene: str, first_free: int, solver: Solver, motion_only: bool = False) -> Video:
    video = Video(stored[f"{scene}_intrinsics"])
    for n, pose in enumerate(matrices(stored[f"{scene}_poses"])):
        frame = VideoFrame(n, float(n), pose, stored[f"{scene}_disps"][n].astype(np.float64), None)  # type: ignore[arg-type]
        frame.damping = (
            stored[f"{scene}_eta"][n].astype(np.float64) - 1e-7
        ) / 0.2  # what `solve` makes of the network's
        video.append(frame)
    edges = [
        Factor(int(i), int(j), target.transpose(1, 2, 0), weight.transpose(1, 2, 0))
        for i, j, target, weight in zip(*(stored[f"{scene}_{key}"] for key in ("ii", "jj", "target", "weight")))
    ]
    assert not solve(video, edges, first_free, solver, motion_only=motion_only, threads=1).failure
    return video


def found(video: Video) -> tuple[np.ndarray, np.ndarray]:
    frames = video.frames
    return np.stack([f.cam_from_world for f in frames]), np.stack([f.inverse_depth for f in frames])


@pytest.mark.parametrize(
    ("case", "scene", "first_free", "solver"),
    [("b", "A", 1, LOCAL), ("c", "A", 2, LOCAL), ("d", "A", 1, GLOBAL), ("g", "B", 1, LOCAL)],
)
def test_the_graphs_solve_is_the_complete_step(
    stored: dict[str, np.ndarray], case: str, scene: str, first_free: int, solver: Solver
) -> None:
    poses, depths = found(run(stored, scene, first_free, solver))
    np.testing.assert_allclose(poses, matrices(stored[f"{case}_full_poses"]), atol=EXACT)
    np.testing.assert_allclose(depths, stored[f"{case}_full_disps"], atol=EXACT)


def test_poses_alone(stored: dict[str, np.ndarray]) -> None:
    poses, depths = found(run(stored, "A", 1, LOCAL, motion_only=True))
    np.testing.assert_allclose(poses, matrices(stored["e_poses"]), atol=EXACT)
    np.testing.assert_allclose(poses, matrices(stored["e_official_poses"]), atol=SINGLE)
    np.testing.assert_array_equal(depths, stored["e_official_disps"])


def test_one_step_solves_the_stored_equations(stored: dict[str, np.ndarray]) -> None:
    video = run(stored, "A", 1, replace(LOCAL, steps=1))
    poses, depths = found(video)
    before = matrices(stored["A_poses"])
    dx = geometry.se3_log(poses[1:] @ geometry.inverse(before[1:]))
    dz = (depths - stored["A_disps"]).reshape(len(poses), -1)
    np.testing.assert_allclose(dx, stored["a_dx"], atol=EXACT)
    np.testing.assert_allclose(dz, stored["a_full_dz"], atol=EXACT)
    np.testing.assert_array_equal(stored["a_kx"], np.arange(5))
    e, c, w = stored["a_E"], stored["a_C"], stored["a_w"]  # coupling, curvature with damping, right side of the depths
    right = (stored["a_v"] - np.einsum("pmxa,ma,ma->px", e, 1 / c, w)).ravel()
    schur = (stored["a_H"].transpose(0, 2, 1, 3) - np.einsum("pmxa,ma,qmya->pxqy", e, 1 / c, e)).reshape(24, 24)
    for reduced in (schur, stored["a_S"]):
        for side in (right, stored["a_rhs"]):
            step = np.linalg.solve(reduced + np.diag(0.1 + 1e-4 * np.diag(reduced)), side)
            np.testing.assert_allclose(dx.ravel(), step, atol=EXACT)
    np.testing.assert_allclose(dx.ravel(), np.linalg.solve(stored["a_Sdamped"], stored["a_rhs"]), atol=EXACT)
    coupled = np.einsum("pmxa,px->pma", e, dx)
    np.testing.assert_allclose(dz, (w - coupled.sum(axis=0)) / c, atol=AMPLIFIED)
    # theirs: the same poses; the depths without the first free pose's part
    np.testing.assert_allclose(poses, matrices(stored["a_official_poses"]), atol=SINGLE)
    np.testing.assert_allclose(poses, matrices(stored["a_skip_poses"]), atol=EXACT)
    without = dz + coupled[0] / c
    np.testing.assert_allclose(without, stored["a_skip_dz"], atol=AMPLIFIED)
    theirs = np.maximum(stored["A_disps"] + without.reshape(depths.shape), 1e-3)
    np.testing.assert_allclose(theirs, stored["a_official_disps"], atol=SINGLE)
    np.testing.assert_allclose(theirs, stored["a_skip_disps"], atol=AMPLIFIED)
    assert np.abs(depths - stored["a_official_disps"]).max() > 0.01  # so that this test could fail
