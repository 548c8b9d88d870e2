"""The color affine of a render: gains of the channels alone take a quicker way than what mixes them."""

from __future__ import annotations

import torch

from mvsgs_core.rasterizer.rasterize import rasterize
from tests.support.rasterizer_scenes import POSE, intrinsics, random_splats

SIZE = (60, 80)
GAINS = torch.tensor([[1.3, 0.0, 0.0, -0.05], [0.0, 1.2, 0.0, 0.02], [0.0, 0.0, 0.8, 0.03]])
MIXED = torch.tensor([[1.3, 0.1, 0.0, -0.05], [0.0, 1.2, -0.2, 0.02], [0.05, 0.0, 0.8, 0.03]])


def test_gains_and_mixed_channels_are_both_the_affine_of_the_color_and_so_are_their_gradients() -> None:
    splats = random_splats(40, seed=3)
    weights = torch.rand(*SIZE, 3, generator=torch.Generator().manual_seed(0))
    for affine in (GAINS, MIXED):
        plain = rasterize(splats, POSE, intrinsics(SIZE), SIZE)
        expected = torch.einsum("ij,hwj->hwi", affine[:, :3], plain.color) + affine[:, 3]
        for trained in (False, True):
            sh = splats.sh.detach().clone().requires_grad_()
            given = affine.clone().requires_grad_(trained)
            moved = type(splats)(**{**vars(splats), "sh": sh})
            color = rasterize(moved, POSE, intrinsics(SIZE), SIZE, exposure=given).color
            torch.testing.assert_close(color, expected, atol=1e-6, rtol=1e-5)
            (color * weights).sum().backward()
            assert sh.grad is not None
            reference = splats.sh.detach().clone().requires_grad_()
            back = weights @ affine[:, :3]
            moved = type(splats)(**{**vars(splats), "sh": reference})
            (rasterize(moved, POSE, intrinsics(SIZE), SIZE).color * back).sum().backward()
            torch.testing.assert_close(sh.grad, reference.grad, atol=1e-5, rtol=1e-4)
            assert (given.grad is not None) == trained
