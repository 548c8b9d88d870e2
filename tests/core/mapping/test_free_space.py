"""Splats before surfaces that a keyframe knows are removed; what is on them, or before what nobody knows, stays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from mvsgs_core.mapping.free_space import in_free_space
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.rasterizer.splats import Splats
from tests.support.small_maps import CONFIG
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

HERE = 7  # anchor of the splats that a test adds


def hung(mapper: OnlineMapper, fraction: float) -> int:
    """Adds a wide splat of a lie at this fraction of the depth in the middle of the first keyframe; returns how many
    splats there were before."""
    view, keyframe = mapper.views[0], rgbd_keyframe(0, pose_on_arc(0.0))
    height, width = keyframe.depth.shape
    z = fraction * float(keyframe.depth[height // 2, width // 2]) / mapper.frame.length
    center = view.refined_from_cam @ np.array([0.0, 0.0, z, 1.0])
    before, bases = len(mapper.state), mapper.state.splats.sh.shape[1]
    mapper.state.append(
        Splats(
            torch.from_numpy(center[None, :3]).float(), torch.full((1, 3), math.log(0.05 * z)),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1,), 3.0), torch.ones((1, bases, 3)),
            torch.full((1,), 2.0),
        ),
        torch.full((1,), HERE),
    )  # fmt: skip
    return before


def mapper_of(nearer: float = InsertionConfig().free_space) -> OnlineMapper:
    mapper = OnlineMapper(replace(CONFIG, insertion=InsertionConfig(free_space=nearer)))
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.0)))
    return mapper


def test_what_hangs_before_a_known_surface_is_removed_and_the_surface_stays() -> None:
    mapper = mapper_of()
    before = hung(mapper, 0.4)
    mapper.add_keyframe(rgbd_keyframe(1, pose_on_arc(0.05)))
    assert not bool((mapper.state.anchors == HERE).any())
    assert int((mapper.state.anchors == 0).sum()) > 0.98 * before
    assert mapper.log.counts["in_free_space"] >= 1


def test_it_stays_where_it_is_near_the_surface_or_no_depth_is_known_or_it_is_switched_off() -> None:
    on_the_surface = mapper_of()
    hung(on_the_surface, 0.95)
    on_the_surface.add_keyframe(rgbd_keyframe(1, pose_on_arc(0.05)))
    nothing_known = mapper_of()
    hung(nothing_known, 0.4)
    blind = rgbd_keyframe(1, pose_on_arc(0.05))
    nothing_known.add_keyframe(replace(blind, depth=np.zeros_like(blind.depth)))
    off = mapper_of(0.0)
    hung(off, 0.4)
    off.add_keyframe(rgbd_keyframe(1, pose_on_arc(0.05)))
    for mapper in (on_the_surface, nothing_known, off):
        assert int((mapper.state.anchors == HERE).sum()) == 1


def test_light_is_the_blending_weights() -> None:
    mapper = mapper_of()
    view = mapper.views[0]
    render = mapper.trainer.render(view, mapper.median_depth)
    images = torch.ones((*view.size, 3))
    images[: view.size[0] // 2, :, 1] = 0.0
    light = mapper.trainer.light(view, mapper.median_depth, images)
    assert light.shape == (len(mapper.state), 3)
    torch.testing.assert_close(light[:, 0].sum(), render.opacity.sum(), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(light[:, 1].sum(), render.opacity[view.size[0] // 2 :].sum(), rtol=1e-3, atol=0.0)
    assert mapper.state.splats.sh.grad is None


def test_a_splat_needs_a_share_on_known_depth_and_to_be_nearer_than_the_mean() -> None:
    everything, known = torch.full((4,), 10.0), torch.tensor([10.0, 2.0, 10.0, 0.0])
    z = torch.tensor([1.0, 1.0, 1.9, 1.0])
    found = in_free_space(torch.stack([everything, known, known / 2.0], dim=1), z, 0.75)
    assert found.tolist() == [True, False, False, False]
