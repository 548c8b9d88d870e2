"""The map follows a loop closure: poses and scales that had drifted are corrected under a mapper that built on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

pytestmark = pytest.mark.slow

DRIFT = 0.25  # share by which lengths have shrunk at the end
REFINEMENT = 60


def drifted(views: list[RGBDKeyframe]) -> tuple[list[RGBDKeyframe], np.ndarray]:
    """Every step and depth shrinks a little more: as a tracker without loops sees it; and the factors (K,)."""
    factors = np.exp(-DRIFT * np.arange(len(views)) / len(views))
    found = [views[0]]
    for before, view, factor in zip(views, views[1:], factors[1:]):
        step = np.linalg.inv(before.world_from_cam) @ view.world_from_cam
        step[:3, 3] *= factor
        depth = (view.depth * factor).astype(np.float32)
        found.append(replace(view, world_from_cam=found[-1].world_from_cam @ step, depth=depth))
    return found, factors


def mapped(views: list[RGBDKeyframe]) -> OnlineMapper:
    mapper = OnlineMapper(MapperConfig(iterations=12, threads=1))
    for view in views:
        mapper.add_keyframe(view)
    while mapper.step():
        pass
    return mapper


def refined(mapper: OnlineMapper) -> float:
    """PSNR over all keyframes after a refinement."""
    for done in range(REFINEMENT):
        mapper.refine(done, REFINEMENT)
    return psnr(mapper)


def psnr(mapper: OnlineMapper) -> float:
    errors = [float((mapper.render(v).color - v.target).square().mean()) for v in mapper.views]
    return float(-10.0 * np.log10(np.mean(errors)))


def test_a_map_that_is_corrected_renders_as_well_as_one_that_never_drifted() -> None:
    views = [rgbd_keyframe(k, pose_on_arc(k / 7)) for k in range(8)]
    wrong, factors = drifted(views)
    follows, stays, knows = mapped(wrong), mapped(wrong), mapped(views)
    poses = np.stack([view.world_from_cam for view in views])
    assert follows.correct(np.arange(8), poses, 1.0 / factors) > 0
    for view, truth, factor in zip(follows.views, views, factors):
        np.testing.assert_allclose(view.world_from_cam, truth.world_from_cam)
        assert view.scale == 1.0 / factor
    corrected = refined(follows)
    assert corrected > refined(stays) - 0.3
    assert corrected > refined(knows) - 1.0  # what was trained at wrong poses takes its time to be forgotten
    assert corrected > 45.5
