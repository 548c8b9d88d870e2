"""A keyframe's pose learns from the map; the first keyframe holds the frame of reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import camera, geometry
from mvsgs_core.mapping.camera_optimizer import step_pose
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

TIMES = (0.0, 0.33, 0.66, 1.0)
OFF = 2.0 * np.array([0.01, -0.008, 0.006, 0.006, -0.008, 0.01])  # (translation, rotation) that one pose is wrong by
TRAINING = TrainingConfig(refine_poses=True, pose_rate=5e-4)


def views(unit: float = 1.0) -> list[RGBDKeyframe]:
    return [rgbd_keyframe(5 * k, pose_on_arc(t), unit=unit) for k, t in enumerate(TIMES)]


def mapped(given: list[RGBDKeyframe], training: TrainingConfig) -> OnlineMapper:
    mapper = OnlineMapper(MapperConfig(iterations=25, refinement=0, training=training, device="cpu"))
    for view in given:
        mapper.add_keyframe(view)
    for _ in range(100):
        mapper.schedule.add_budget(1)
        mapper.step()
    return mapper


def shift(view: RGBDKeyframe, pose: np.ndarray) -> float:
    """Mean shift in pixels of the view's points when they are seen from `pose`, in place of the view's own."""
    points = camera.unproject(view.depth, view.intrinsics).reshape(-1, 3)
    there = geometry.inverse(pose) @ view.world_from_cam
    seen = points @ there[:3, :3].T + there[:3, 3]
    focal = view.intrinsics[:2]
    moved = focal * (seen[:, :2] / seen[:, 2:] - points[:, :2] / points[:, 2:])
    return float(np.linalg.norm(moved, axis=1).mean())


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_wrong_pose_is_mended_and_the_first_one_stays(unit: float) -> None:
    given = views(unit)
    truth = given[2]
    wrong = truth.world_from_cam @ geometry.se3_exp(OFF * [unit, unit, unit, 1, 1, 1])
    # without depth: it adds no splats at the wrong place, the others explain it
    given[2] = replace(given[2], world_from_cam=wrong, depth=np.zeros_like(given[2].depth), normals=None)
    final = mapped(given, TRAINING).snapshot()
    assert np.array_equal(final.world_from_cam[0], given[0].world_from_cam)
    assert shift(truth, wrong) > 1.0
    assert shift(truth, final.world_from_cam[2]) < 0.5 * shift(truth, wrong)
    rotation = final.world_from_cam[2, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_without_the_switch_poses_are_the_trackers() -> None:
    final = mapped(views(), replace(TRAINING, refine_poses=False)).snapshot()
    np.testing.assert_array_equal(final.world_from_cam, np.stack([v.world_from_cam for v in views()]))


def test_a_correction_keeps_what_was_refined_in_the_new_scale() -> None:
    mapper = mapped(views(), TRAINING)
    before = mapper.snapshot()
    moved = geometry.se3_exp(np.array([0.3, 0.1, -0.2, 0.2, 0.4, -0.1]))
    poses = np.stack([v.world_from_cam for v in views()])
    poses[:, :3, 3] *= 2.0
    mapper.correct(before.keyframes, moved @ poses, np.full(4, 2.0))
    after = mapper.snapshot()
    expected = before.world_from_cam.copy()
    expected[:, :3, 3] *= 2.0
    np.testing.assert_allclose(after.world_from_cam, moved @ expected, atol=1e-9)


def test_a_gradient_that_is_not_finite_moves_nothing() -> None:
    mapper = OnlineMapper(MapperConfig(device="cpu"))
    mapper.add_keyframe(views()[0])
    view = mapper.views[0]
    assert not step_pose(view, np.array([0, 0, np.nan, 0, 0, 0.0]), 1e-3, 1e-3)
    assert np.array_equal(view.pose_delta, np.eye(4))
    assert view.pose_steps == 0
    assert not view.pose_moments.any()
    assert step_pose(view, np.array([0, 0, 1.0, 0, 0, 0.0]), 1e-3, 2e-3)
    np.testing.assert_allclose(view.pose_delta[:3, 3], [0, 0, -2e-3])
