"""Refinement of dataset poses, on the synthetic room with poses that were spoiled on purpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.depth.data import load_scene
from bench.depth.pose_refinement import refine_poses
from mvsgs_core import geometry

pytestmark = pytest.mark.slow


def _turns(views: list, truths: list) -> float:
    """Degrees, mean error of the rotation from one keyframe to the next."""
    errors = []
    for a, b, true_a, true_b in zip(views, views[1:], truths, truths[1:]):
        found = geometry.inverse(a.world_from_cam) @ b.world_from_cam
        true = geometry.inverse(true_a.world_from_cam) @ true_b.world_from_cam
        errors.append(np.degrees(np.linalg.norm(geometry.se3_log(geometry.inverse(true) @ found)[3:])))
    return float(np.mean(errors))


def test_spoiled_rotations_are_found_again_and_scale_stays() -> None:
    scene = load_scene("room", 160 * 120, 6)
    rng = np.random.default_rng(0)
    spoil = [np.concatenate([np.zeros(3), np.radians(0.7) * rng.normal(size=3)]) for _ in scene.views]
    views = [
        replace(v, world_from_cam=v.world_from_cam @ geometry.se3_exp(x))
        for v, x in zip(scene.views, spoil, strict=True)
    ]
    better, before, after = refine_poses(replace(scene, views=views))
    assert after < 0.3 * before
    assert _turns(better.views, scene.views) < 0.25 * _turns(views, scene.views)
    length = [
        np.linalg.norm(v[-1].world_from_cam[:3, 3] - v[0].world_from_cam[:3, 3]) for v in (better.views, scene.views)
    ]
    assert abs(length[0] / length[1] - 1.0) < 0.03
