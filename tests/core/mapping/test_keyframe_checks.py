"""Keyframes that no camera gives: refused and counted, and the map goes on as if they had not come."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_maps import mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

CONFIG = MapperConfig(iterations=2, refinement=0, threads=1, device="cpu")
VIEWS = [
    replace(rgbd_keyframe(k, pose_on_arc(k / 4), (24, 32)), confidence=np.ones((24, 32), np.float32)) for k in range(4)
]


def is_sound(mapper: OnlineMapper) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in mapper.state.tensors().values())


def with_far_pixels(view: RGBDKeyframe, factor: float) -> RGBDKeyframe:
    depth = view.depth.copy()
    depth[0, 0] = depth[-1, -1] = factor * np.median(depth)
    return replace(view, depth=depth)


@pytest.mark.parametrize("factor", [3e6, 1e9, 1e30])
def test_a_far_pixel_of_depth_is_left_out_and_the_rest_is_mapped(factor: float) -> None:
    views = [with_far_pixels(VIEWS[0], factor), *VIEWS[1:3]]
    mapper, calm = mapped(views), mapped(VIEWS[:3])
    assert len(mapper.views) == 3
    assert is_sound(mapper)
    assert abs(len(mapper.state) - len(calm.state)) <= 40
    assert mapper.log.counts["refused_far_points"] == 2
    assert any("too far away" in text for text in mapper.log.warnings)
    assert float(mapper.state.splats.means.detach().abs().max()) < 1e3


def test_a_far_pixel_of_doubtful_depth_is_left_out_too() -> None:
    unfiltered = np.full((24, 32), 1e9, np.float32)
    depth = VIEWS[1].depth.copy()
    depth[:, 16:] = 0
    mapper = mapped([VIEWS[0], replace(VIEWS[1], depth=depth, unfiltered=unfiltered)], CONFIG)
    assert is_sound(mapper)
    assert float(mapper.state.splats.means.detach().abs().max()) < 1e6


BAD: dict[str, dict[str, Any]] = {
    "a principal point far outside of the image": {"intrinsics": np.array([25.6, 25.6, 1e9, 11.5])},
    "a focal length that no camera has": {"intrinsics": np.array([1e-9, 1e-9, 15.5, 11.5])},
    "a focal length that no camera has ": {"intrinsics": np.array([-25.6, 25.6, 15.5, 11.5])},
    "a focal length that no camera has  ": {"intrinsics": np.array([25.6, 1e9, 15.5, 11.5])},
    "a pose or intrinsics that are not finite": {"intrinsics": np.array([25.6, np.nan, 15.5, 11.5])},
    "a pose that is no rotation": {"world_from_cam": np.diag([1.0, 1.0, 0.0, 1.0])},
    "a pose that is no rotation ": {"world_from_cam": np.diag([1e200, 1e200, 1e200, 1.0])},
    "a pose that is no rotation and position": {"world_from_cam": np.diag([1.0, 1.0, -1.0, 1.0])},
    "a scale that no map has": {"scale": 1e300},
    "a pose or intrinsics that are not finite ": {"scale": float("inf")},
    "an image smaller than": {"image": np.zeros((2, 32, 3), np.uint8)},
    "an empty depth map": {"depth": np.zeros((0, 4), np.float32)},
    "far away from all others": {"world_from_cam": np.block([[np.eye(3), np.full((3, 1), 1e30)], [0, 0, 0, 1]])},
    "or with depth so large": {"depth": np.full((24, 32), 1e30, np.float32)},
}


@pytest.mark.parametrize("problem", BAD)
@pytest.mark.parametrize("first", [True, False])
def test_a_keyframe_that_no_camera_gives_is_refused_by_its_reason(problem: str, first: bool) -> None:
    bad = replace(VIEWS[1], **BAD[problem])
    if first and "far away" in problem:
        pytest.skip("the first one is where the map begins")
    mapper = mapped([bad, VIEWS[0], VIEWS[2]] if first else [VIEWS[0], bad, VIEWS[2]], CONFIG)
    assert [view.index for view in mapper.views] == [0, 2]
    assert mapper.log.counts["refused_views"] == 1
    assert problem.strip() in mapper.log.warnings[0]
    calm = mapped([VIEWS[0], VIEWS[2]], CONFIG)
    assert torch.equal(mapper.state.splats.means, calm.state.splats.means)


def test_a_correction_that_is_no_pose_is_refused() -> None:
    mapper = mapped(VIEWS[:2], CONFIG)
    before = mapper.state.splats.means.detach().clone()
    far, flat = pose_on_arc(0.25), np.diag([1.0, 1.0, 0.0, 1.0])
    far[0, 3] = 1e300
    assert mapper.correct(np.array([0, 1, 1]), np.stack([far, flat, pose_on_arc(0.25)]), np.array([1, 1, 1e300])) == 0
    assert mapper.log.counts["refused_poses"] == 3
    assert torch.equal(mapper.state.splats.means, before)


@pytest.mark.slow
def test_no_mutated_keyframe_ends_the_map_or_makes_it_unsound() -> None:
    """Every field with what no camera gives, singly and at a few pixels; the map goes on after each."""
    random = np.random.default_rng(0)
    wild = np.array([0.0, -1.0, 1e-40, 1e-9, 1e9, 3e4, 1e19, 3e38, -3e38, np.nan, np.inf, -np.inf])
    training = TrainingConfig(refine_poses=True, pose_visits=1)
    mapper = OnlineMapper(replace(CONFIG, iterations=1, sh_degree=1, training=training))
    mapper.add_keyframe(VIEWS[0])
    for index in range(1, 120):
        view = replace(rgbd_keyframe(index, pose_on_arc(random.random()), (24, 32)), unfiltered=VIEWS[0].depth.copy())
        light = {"exposure": np.eye(3, 4, dtype=np.float32), "vignetting": np.zeros(3, np.float32)}
        changes: dict[str, Any] = {"confidence": np.ones((24, 32), np.float32), **light}
        for name in random.choice(
            ["depth", "confidence", "normals", "unfiltered", "intrinsics", "pose", "scale", "exposure", "vignetting"], 2
        ):
            value = random.choice(wild)
            if name == "scale":
                changes["scale"] = float(value)
                continue
            field = "world_from_cam" if name == "pose" else str(name)
            array = np.array(changes.get(field, getattr(view, field)))
            if random.random() < 0.5:
                array.flat[random.integers(array.size, size=3)] = value
            else:
                with np.errstate(all="ignore"):
                    array = array * array.dtype.type(value)
            changes[field] = array
        with np.errstate(all="ignore"):
            mapper.add_keyframe(replace(view, **changes))
            mapper.step()
        if index % 20 == 0:
            assert is_sound(mapper), changes
            with np.errstate(all="ignore"):
                mapper.correct(
                    np.array([index - 1]), changes.get("world_from_cam", view.world_from_cam)[None], np.ones(1)
                )
    assert is_sound(mapper)
    assert 15 < mapper.log.counts["refused_views"] < 100
    assert torch.isfinite(mapper.render(mapper.views[0]).color).all()
