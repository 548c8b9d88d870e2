"""Splats follow their anchor keyframe: render unchanged, moments in the new frame, harmonics turned."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.mapping.deformation import move_with_anchors
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.sh_rotation import sh_rotation
from mvsgs_core.rasterizer.spherical_harmonics import basis
from mvsgs_core.rasterizer.splats import Splats

OLD = geometry.se3_exp(np.array([0.3, -0.1, 0.2, 0.1, 0.4, -0.2]))
NEW = geometry.se3_exp(np.array([-0.5, 0.4, 0.1, -0.6, 0.2, 0.9]))
INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])


def splats_before(pose: np.ndarray, bases: int = 9) -> Splats:
    generator = torch.Generator().manual_seed(3)
    cam = torch.randn((40, 3), generator=generator).numpy() * [0.6, 0.4, 0.3] + [0, 0, 2.5]
    return Splats(
        torch.from_numpy(cam @ pose[:3, :3].T + pose[:3, 3]).float(),
        torch.randn((40, 3), generator=generator) * 0.4 - 2.2,
        torch.randn((40, 4), generator=generator),
        torch.randn(40, generator=generator),
        torch.randn((40, bases, 3), generator=generator) * 0.4,
        torch.full((40,), 2.0),
    )


def test_the_anchor_sees_the_same_image_after_a_correction_with_scale() -> None:
    state = MapState(9, torch.device("cpu"))
    state.append(splats_before(OLD), torch.full((40,), 7))
    before = rasterize(state.detached(), OLD, INTRINSICS, (24, 32), backend="reference")
    assert move_with_anchors(state, {7: geometry.Similarity.between(OLD, NEW, 1.7)}) == 40
    after = rasterize(state.detached(), NEW, INTRINSICS, (24, 32), backend="reference")
    assert before.opacity.mean() > 0.2
    torch.testing.assert_close(after.color, before.color, atol=2e-4, rtol=0)
    torch.testing.assert_close(after.depth, 1.7 * before.depth, atol=1e-3, rtol=0)


def test_only_the_named_anchors_move() -> None:
    state = MapState(9, torch.device("cpu"))
    state.append(splats_before(OLD), torch.arange(40) % 4)
    before = state.detached().means.clone()
    change = geometry.Similarity.between(OLD, NEW, 1.0)
    assert move_with_anchors(state, {2: change, 9: change}) == 10
    moved = (state.detached().means != before).any(dim=1)
    assert torch.equal(moved, torch.arange(40) % 4 == 2)


def test_moments_follow_the_change_of_variables() -> None:
    """A gradient's mean in the old frame becomes the gradient in the new one: the chain rule, by autograd."""
    state = MapState(9, torch.device("cpu"))
    state.append(splats_before(OLD), torch.full((40,), 1))
    target = torch.randn((40, 3), generator=torch.Generator().manual_seed(5))
    similarity = geometry.Similarity.between(OLD, NEW, 1.7)
    old_means = state.detached().means.clone().requires_grad_(True)
    (torch.sin(old_means) * target).sum().backward()
    state.first["means"] = old_means.grad.clone()
    state.second["means"] = old_means.grad.square()
    move_with_anchors(state, {1: similarity})
    new_means = state.detached().means.clone().double().requires_grad_(True)
    back = (new_means - torch.from_numpy(similarity.translation)) @ torch.from_numpy(similarity.rotation) / 1.7
    (torch.sin(back) * target).sum().backward()
    torch.testing.assert_close(state.first["means"].double(), new_means.grad, atol=1e-5, rtol=1e-4)
    squares = (torch.from_numpy(similarity.rotation / 1.7) ** 2 @ old_means.grad.double().square().T).T
    torch.testing.assert_close(state.second["means"].double(), squares, atol=1e-6, rtol=1e-4)


def test_left_multiplication_is_the_product_of_rotations() -> None:
    a, b = geometry.quaternion_from_rotation(np.stack([OLD[:3, :3], NEW[:3, :3]]))
    product = geometry.left_multiplication(a[None])[0] @ b
    np.testing.assert_allclose(geometry.rotation_from_quaternion(product), OLD[:3, :3] @ NEW[:3, :3], atol=1e-12)


def test_turned_harmonics_show_the_same_color_in_the_turned_direction() -> None:
    rotation = NEW[:3, :3]
    random = np.random.default_rng(0)
    directions = random.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = random.normal(size=(16, 3))
    before = basis(torch.from_numpy(directions), 3).numpy() @ sh
    after = basis(torch.from_numpy(directions @ rotation.T), 3).numpy() @ (sh_rotation(rotation, 16) @ sh)
    np.testing.assert_allclose(after, before, atol=1e-9)
