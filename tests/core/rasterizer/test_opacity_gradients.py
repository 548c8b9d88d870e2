"""Gradients of opacities alone are those that a whole backward pass gives, of C++ and of its twin in PyTorch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mvsgs_core.rasterizer.rasterize import Render, rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import POSE, intrinsics, random_splats

SIZE = (40, 56)


def slope(splats: Splats, *, depth: bool = False, **options: object) -> tuple[Tensor, Render]:
    """By the logits, of a random weighting of the colors, with depth and opacity besides."""
    render = rasterize(splats, POSE, intrinsics(SIZE), SIZE, **options)  # type: ignore[arg-type]
    g = torch.Generator().manual_seed(3)
    signs = torch.rand(*SIZE, 3, generator=g).to(render.color) - 0.5
    value = (render.color * signs).sum()
    if depth:
        value = value + 0.1 * (render.depth * signs[..., 0]).sum() + (render.opacity * signs[..., 1]).sum()
    (found,) = torch.autograd.grad(value, [splats.opacity_logits])
    return found, render


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("options", [{}, {"kernel": "exact"}, {"antialiased": True}, {"threads": 2}])
def test_they_are_those_of_the_whole_backward_pass(options: dict[str, object], depth: bool) -> None:
    plain = random_splats(300, log_scale=-2.0)
    alone = replace(plain, opacity_logits=plain.opacity_logits.clone().requires_grad_())
    whole = Splats(*(t.clone().requires_grad_() for t in plain.tensors().values()))
    twin = Splats(*(t.double() for t in plain.tensors().values()))
    twin.opacity_logits.requires_grad_()
    found, render = slope(alone, depth=depth, backend="cpu", **options)
    expected, full = slope(whole, depth=depth, backend="cpu", **options)
    exact, _ = slope(twin, depth=depth, backend="reference", **options)
    assert not render.means2d.requires_grad
    assert full.means2d.requires_grad
    assert render.backward.refused == 0
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))
    torch.testing.assert_close(found.double(), exact, rtol=2e-3, atol=2e-4 * float(exact.abs().max()))


def test_what_is_not_finite_is_refused() -> None:
    plain = random_splats(50, log_scale=-2.0)
    alone = replace(plain, opacity_logits=plain.opacity_logits.clone().requires_grad_())
    render = rasterize(alone, POSE, intrinsics(SIZE), SIZE, backend="cpu")
    (render.color * float("inf")).sum().backward()
    assert render.backward.refused
    assert alone.opacity_logits.grad is not None
    assert torch.isfinite(alone.opacity_logits.grad).all()
