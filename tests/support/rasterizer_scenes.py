"""Scenes and comparisons that the rasterizer's tests share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import geometry, native
from mvsgs_core.rasterizer.rasterize import Render, RenderSettings, rasterize
from mvsgs_core.rasterizer.splats import Splats

POSE = geometry.se3_exp(np.array([0.1, -0.05, 0.2, 0.05, -0.1, 0.03]))


def random_splats(count: int, bases: int = 4, seed: int = 0, log_scale: float = -3.0) -> Splats:
    """Splats 2 to 5 units before the camera, a few pixels wide, opacities and exponents of all kinds; float32."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=g) * torch.tensor([4.0, 3.0, 3.0]) + torch.tensor([-2.0, -1.5, 2.0])
    return Splats(
        means=means,
        log_scales=torch.randn(count, 3, generator=g) * 0.4 + log_scale,
        quaternions=torch.randn(count, 4, generator=g),
        opacity_logits=torch.randn(count, generator=g),
        sh=torch.randn(count, bases, 3, generator=g) * 0.3,
        betas=torch.rand(count, generator=g) * 2.5 + 0.8,
    )


def wide_splats(count: int) -> Splats:
    """Each on every tile of any image."""
    ones = torch.ones(count)
    means, quaternions = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    return Splats(
        means.repeat(count, 1), torch.full((count, 3), 3.0), quaternions.repeat(count, 1), ones,
        torch.ones(count, 1, 3), 2 * ones,
    )  # fmt: skip


def render_settings(
    world_from_cam: np.ndarray, camera: np.ndarray, size: tuple[int, int], kernel: str
) -> RenderSettings:
    return RenderSettings(
        pose=torch.from_numpy(world_from_cam), intrinsics=tuple(camera.tolist()), size=size, readout=(0.0,) * 6,
        exact=kernel == "exact", background=(0.0, 0.0, 0.0), near=1e-3, antialiased=False, degree=0, weights=False,
        threads=2,
    )  # fmt: skip


def kernel_pass(
    splats: Splats, world_from_cam: np.ndarray, camera: np.ndarray, size: tuple[int, int], kernel: str = "gaussian",
    **options: Any,
) -> Any:  # fmt: skip
    """What the C++ kernel keeps of a forward pass."""
    settings = render_settings(world_from_cam, camera, size, kernel)
    return native.load("rasterizer").forward(
        settings, settings.pose, list(splats.tensors().values()), color=torch.empty(*size, 3), depth=torch.empty(size),
        opacity=torch.empty(size), radii=torch.empty(len(splats)), **options,
    )  # fmt: skip


def copy(splats: Splats, dtype: torch.dtype = torch.float32, device: str = "cpu") -> Splats:
    """The same values as leaves that take gradients."""
    return Splats(*(t.detach().to(device, dtype, copy=True).requires_grad_() for t in splats.tensors().values()))


def device_of(backend: str) -> str:
    """Where a back end is tested: Triton on a GPU where there is one, else its interpreter on the CPU."""
    return "cuda" if backend == "triton" and torch.cuda.is_available() else "cpu"


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    height, width = size
    return np.array([0.9 * width, 0.95 * width, 0.5 * width - 0.7, 0.5 * height - 0.2])


def gradients(splats: Splats, size: tuple[int, int], seed: int = 1, **options: Any) -> tuple[Render, dict[str, Tensor]]:
    """A render, and the gradients of a random weighting of color, depth and opacity by every input."""
    g = torch.Generator().manual_seed(seed)
    delta = torch.full((6,), 0.01, dtype=torch.float64, requires_grad=True)
    exposure = (torch.eye(3, 4) + 0.05).to(splats.means).requires_grad_()
    render = rasterize(
        splats, POSE, intrinsics(size), size, background=np.array([0.1, 0.2, 0.3]), pose_delta=delta,
        exposure=exposure, weights=True, **options,
    )  # fmt: skip
    loss = sum(
        (image * torch.randn(image.shape, generator=g, dtype=torch.float64).to(image.device)).sum()
        for image in (render.color, render.depth, render.opacity)
    )
    assert isinstance(loss, Tensor)
    loss.backward()
    found = {name: t.grad for name, t in splats.tensors().items() if t.grad is not None}
    assert render.means2d.grad is not None
    assert delta.grad is not None
    assert exposure.grad is not None
    return render, {**found, "means2d": render.means2d.grad, "pose": delta.grad, "exposure": exposure.grad}


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Largest difference over the largest magnitude of the truth."""
    if truth.numel() == 0:
        return 0.0
    return float((value.cpu().double() - truth.double()).abs().max() / truth.double().abs().max().clamp(min=1e-12))


def assert_agree(splats: Splats, size: tuple[int, int], backend: str, **options: Any) -> None:
    """A back end in float32 against the reference in float64: images within 1e-5, gradients within 1e-3.

    A pixel whose alpha lies within rounding of 1/255, or whose transmittance lies within rounding of 1e-4, may fall on
    the other side: at most 1 in 2000 may, and then by no more than such a splat weighs.
    """
    render, found = gradients(copy(splats, device=device_of(backend)), size, backend=backend, **options)
    truth, expected = gradients(copy(splats, torch.float64), size, backend="reference", **options)
    for name in ("color", "depth", "opacity"):
        value, wanted = getattr(render, name).detach().cpu().double(), getattr(truth, name).detach()
        error = (value - wanted).abs() / max(1.0, float(wanted.abs().max()))
        assert float((error > 1e-5).double().mean()) <= 5e-4, name
        assert float(error.max()) < 1e-2, name
    assert found.keys() == expected.keys()
    for name, wanted in expected.items():
        assert relative_error(found[name], wanted) < 1e-3, name
    assert bool((render.visible.cpu() == truth.visible).all())
    assert render.refused == truth.refused
    assert relative_error(render.weight_max, truth.weight_max) < 1e-2  # type: ignore[arg-type]


def assert_finite(render: Render, found: dict[str, torch.Tensor]) -> None:
    for name in ("color", "depth", "opacity", "radii", "weight_max"):
        assert bool(torch.isfinite(getattr(render, name)).all()), name
    for name, gradient in found.items():
        assert bool(torch.isfinite(gradient).all()), f"gradient of {name}"


def extremes(name: str) -> Splats:
    splats = random_splats(60)
    if name == "zero quaternions":
        splats.quaternions[:10] = 0.0
    elif name == "tiny quaternions":
        splats.quaternions[:10] *= 1e-7
    elif name == "scales from 1e-12 to 1e6":
        splats.log_scales[:] = torch.linspace(math.log(1e-12), math.log(1e6), 60)[:, None]
    elif name == "scales beyond float32":
        splats.log_scales[:20] = torch.linspace(30.0, 400.0, 20)[:, None]
        splats.log_scales[20:40] = -torch.linspace(30.0, 400.0, 20)[:, None]
    elif name == "aspect 1:1e5":
        splats.log_scales[:30, 0] = math.log(10.0)
        splats.log_scales[:30, 1:] = math.log(1e-4)
        splats.log_scales[30:, 0] = math.log(1e-5)
        splats.log_scales[30:, 1:] = 0.0
    elif name == "opacity 0 and 1":
        splats.opacity_logits[:30] = -200.0
        splats.opacity_logits[30:] = 200.0
    elif name == "exponents from 0.1 to 20":
        splats.betas[:] = torch.linspace(0.1, 20.0, 60)
    elif name == "exponents out of range":
        splats.betas[:] = torch.linspace(-50.0, 1000.0, 60)
    elif name == "coincident":
        splats.means[:] = splats.means[0].clone()
    elif name == "at and behind the near plane":
        splats.means[:, 2] = torch.linspace(-1.0, 0.3, 60)
    elif name == "in the camera":
        splats.means[:] = torch.from_numpy(np.array([0.1, -0.05, 0.2])).float()
    elif name == "far away":
        splats.means[:] *= torch.logspace(0.0, 18.0, 60)[:, None]
    elif name == "glaring":
        splats.sh[:] *= 1e6
    return splats
