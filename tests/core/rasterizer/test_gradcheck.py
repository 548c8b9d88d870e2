"""The reference's gradients against finite differences in float64, for every input; the C++ ones likewise, coarser."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from mvsgs_core.rasterizer.kernels import KERNELS
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import POSE, copy, gradients, intrinsics, random_splats

SIZE = (5, 6)


def small_scene(bases: int) -> Splats:
    """Wide faint splats: every pixel lies well above alpha = 1/255 and below 0.99, where the image is smooth."""
    splats = random_splats(4, bases, seed=7, log_scale=0.3)
    splats.opacity_logits = splats.opacity_logits * 0.3
    return Splats(*(t.double().requires_grad_() for t in splats.tensors().values()))


def images(kernel: str, antialiased: bool) -> Callable[..., tuple[Tensor, ...]]:
    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        *fields, delta, exposure = inputs
        render = rasterize(
            Splats(*fields), POSE, intrinsics(SIZE), SIZE, kernel=kernel, backend="reference", pose_delta=delta,
            exposure=exposure, antialiased=antialiased, background=np.array([0.2, 0.4, 0.1]),
        )  # fmt: skip
        return render.color, render.depth, render.opacity

    return run


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_reference(kernel: str, bases: int) -> None:
    delta = torch.full((6,), 0.02, dtype=torch.float64, requires_grad=True)
    exposure = (torch.eye(3, 4, dtype=torch.float64) + 0.1).requires_grad_()
    inputs = (*small_scene(bases).tensors().values(), delta, exposure)
    assert torch.autograd.gradcheck(images(kernel, False), inputs, eps=1e-6, atol=1e-6, rtol=1e-4, fast_mode=True)


@pytest.mark.slow
def test_reference_in_full() -> None:
    """Every element of the Jacobian, antialiased."""
    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    exposure = torch.eye(3, 4, dtype=torch.float64).requires_grad_()
    wide = small_scene(4)
    inputs = (*(t[:2].detach().requires_grad_() for t in wide.tensors().values()), delta, exposure)
    assert torch.autograd.gradcheck(images("exact", True), inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_cpu_by_finite_differences(kernel: str) -> None:
    """Central differences of the float32 kernel along random directions, per parameter."""
    scene = random_splats(6, bases=4, seed=3, log_scale=1.0)
    scene.opacity_logits *= 0.3
    size = (16, 20)
    leaves = copy(scene)
    weight = torch.randn(*size, 3, generator=torch.Generator().manual_seed(0))

    def loss(splats: Splats) -> Tensor:
        render = rasterize(splats, POSE, intrinsics(size), size, kernel=kernel, backend="cpu")
        return (render.color * weight).double().sum()

    loss(leaves).backward()  # type: ignore[no-untyped-call]
    for name, field in leaves.tensors().items():
        if name == "betas" and kernel == "gaussian":
            continue
        assert field.grad is not None
        direction = torch.sign(field.grad)
        step = 2e-3
        values = []
        for sign in (1.0, -1.0):
            moved = Splats(*(t.detach().clone() for t in scene.tensors().values()))
            getattr(moved, name).add_(sign * step * direction)
            values.append(loss(moved).item())
        slope = (values[0] - values[1]) / (2 * step)
        assert slope == pytest.approx((field.grad * direction).sum().item(), rel=2e-2, abs=2e-3), name


@pytest.mark.parametrize("beta", [0.1, 0.5, 1.0, 2.0, 20.0])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_center_of_the_exact_form(beta: float, backend: str) -> None:
    """A pixel exactly on the mean: for beta < 1 the slope has no bound there, the gradient is 0 instead of Inf."""
    splats = random_splats(1, bases=1)
    splats.means[0] = torch.tensor([0.0, 0.0, 2.0])
    splats.betas[0] = beta
    leaves = copy(splats)
    camera = np.array([10.0, 10.0, 4.0, 4.0])
    render = rasterize(leaves, np.eye(4), camera, (9, 9), kernel="exact", backend=backend)
    render.color[4, 4].sum().backward()
    for name, field in leaves.tensors().items():
        assert field.grad is not None
        assert bool(torch.isfinite(field.grad).all()), name
    assert leaves.means.grad is not None
    assert float(leaves.means.grad[0, :2].abs().max()) == 0.0


def test_pose_delta_moves_the_camera_in_its_own_frame() -> None:
    """A twist along the camera's x is the pose moved by its x axis: checked through the image, not through the code."""
    splats, size = random_splats(100), (24, 32)
    step = torch.tensor([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    moved = POSE.copy()
    moved[:3, 3] += 0.05 * POSE[:3, 0]
    by_delta = rasterize(splats, POSE, intrinsics(size), size, pose_delta=step)
    by_pose = rasterize(splats, moved, intrinsics(size), size)
    torch.testing.assert_close(by_delta.color, by_pose.color, rtol=0, atol=1e-5)


def test_the_gradient_of_means2d_is_in_units_of_half_the_image() -> None:
    splats, size = random_splats(50, seed=1), (24, 48)
    _, found = gradients(copy(splats), size, backend="cpu")
    _, expected = gradients(copy(splats, torch.float64), size, backend="reference")
    assert float(expected["means2d"].abs().max()) > 0
    torch.testing.assert_close(found["means2d"].double(), expected["means2d"], rtol=1e-3, atol=1e-3)
