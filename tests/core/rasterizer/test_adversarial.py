"""Splats that break rasterizers: none may bring NaN or Inf into the image or into any gradient."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.rasterizer.kernels import KERNELS
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import assert_finite, copy, extremes, gradients, intrinsics, random_splats

SIZE = (40, 56)
BACKENDS = ("cpu", "reference")
BAD_VALUES = (math.nan, math.inf, -math.inf)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("field", ["means", "log_scales", "quaternions", "opacity_logits", "sh", "betas"])
def test_a_parameter_that_is_not_finite(backend: str, field: str) -> None:
    clean = random_splats(60)
    splats = random_splats(60)
    for i, bad in enumerate(BAD_VALUES):
        getattr(splats, field)[i].view(-1)[0] = bad
    render, found = gradients(copy(splats), SIZE, backend=backend)
    assert_finite(render, found)
    assert render.refused == 3
    assert not bool(render.visible[:3].any())
    assert all(bool((found[name][:3] == 0).all()) for name in ("means", "sh", "means2d"))
    rest = Splats(*(t[3:] for t in clean.tensors().values()))
    without, _ = gradients(copy(rest), SIZE, backend=backend)
    torch.testing.assert_close(render.color, without.color, rtol=0, atol=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_gradients_that_are_not_finite_are_refused_and_counted(bad: float) -> None:
    """One pixel's gradient is bad: the splats seen there get none, the others theirs, and the count says how many."""
    splats = copy(random_splats(60))
    render = rasterize(splats, np.eye(4), intrinsics(SIZE), SIZE, backend="cpu")
    assert render.backward.refused is None
    gradient = torch.ones_like(render.color)
    row, column = divmod(int(render.opacity.detach().argmax()), SIZE[1])
    gradient[row, column] = bad
    render.color.backward(gradient)  # type: ignore[no-untyped-call]
    assert render.backward.refused is not None
    assert 0 < render.backward.refused < int(render.visible.sum())
    for name, field in splats.tensors().items():
        assert field.grad is None or bool(torch.isfinite(field.grad).all()), name
    assert splats.means.grad is not None
    without = int((render.visible & (splats.means.grad == 0).all(dim=1)).sum())
    assert without >= render.backward.refused


@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_splats_whose_gradients_are_refused_stay_as_they_were(kernel: str) -> None:
    """However their moments would move them; the others are stepped."""
    state = MapState(4, torch.device("cpu"))
    state.append(random_splats(60), torch.zeros(60, dtype=torch.int64))
    for name in PARAMETERS:
        state.first[name].fill_(0.1)
        state.second[name].fill_(0.01)
    camera: Any = (np.eye(4), intrinsics(SIZE), SIZE)
    options: Any = {"kernel": kernel, "backend": "cpu"}
    splats = copy(state.splats)
    render = rasterize(splats, *camera, **options)
    gradient = torch.ones_like(render.color)
    gradient[divmod(int(render.opacity.detach().argmax()), SIZE[1])] = math.nan
    render.color.backward(gradient)  # type: ignore[no-untyped-call]
    assert splats.opacity_logits.grad is not None
    refused = render.visible & (splats.opacity_logits.grad == 0)
    assert int(refused.sum()) == render.backward.refused

    before = {name: value.clone() for name, value in state.tensors().items()}
    groups = optimizer.groups(optimizer.OptimizerConfig(), 1.0, 1.0, kernel == "exact", kernel)
    step = optimizer.splat_step(state, groups, 100)
    render = rasterize(state.splats, *camera, **options, step=step)
    render.color.backward(gradient)  # type: ignore[no-untyped-call]
    assert render.backward.refused == int(refused.sum())
    assert step.refused == 0
    stepped = render.visible & ~refused
    assert 0 < int(refused.sum()) < int(render.visible.sum())
    assert torch.equal(state.steps, stepped.to(torch.int32))
    assert torch.equal(state.means2d_views, render.visible.to(torch.float32))
    assert bool((state.splats.means != before["means"]).all(dim=1)[stepped].all())
    for name, value in state.tensors().items():
        if not name.startswith("means2d"):
            assert torch.equal(value[~stepped], before[name][~stepped]), name


EXTREMES = (
    "zero quaternions", "tiny quaternions", "scales from 1e-12 to 1e6", "scales beyond float32", "aspect 1:1e5",
    "opacity 0 and 1", "exponents from 0.1 to 20", "exponents out of range", "coincident",
    "at and behind the near plane", "in the camera", "far away", "glaring",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_stay_finite(name: str, kernel: str) -> None:
    splats = extremes(name)
    for antialiased in (False, True):
        render, found = gradients(copy(splats), SIZE, backend="cpu", kernel=kernel, antialiased=antialiased)
        assert_finite(render, found)
    if name == "zero quaternions":
        assert render.refused == 10


@pytest.mark.parametrize("name", EXTREMES)
def test_the_reference_stays_finite(name: str) -> None:
    render, found = gradients(copy(extremes(name)), SIZE, backend="reference", kernel="exact")
    assert_finite(render, found)


@pytest.mark.parametrize("backend", BACKENDS)
def test_zero_splats(backend: str) -> None:
    background = np.array([0.3, 0.2, 0.1])
    splats = copy(Splats.empty(4))
    render = rasterize(splats, np.eye(4), intrinsics(SIZE), SIZE, backend=backend, background=background, weights=True)
    assert render.color[0, 0].detach().tolist() == pytest.approx([0.3, 0.2, 0.1])
    assert not bool(render.opacity.any())
    assert not bool(render.depth.any())
    assert render.visible.shape == (0,)
    render.color.sum().backward()
    assert splats.sh.grad is not None
    assert splats.sh.grad.shape == (0, 4, 3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_in_view(backend: str) -> None:
    splats = random_splats(30)
    splats.means[:, 2] *= -1.0
    render, found = gradients(copy(splats), SIZE, backend=backend)
    assert_finite(render, found)
    assert not bool(render.visible.any())
    assert render.refused == 0
    assert float(found["means"].abs().max()) == 0.0


def test_what_does_not_fit_is_refused_with_its_name() -> None:
    splats, camera = random_splats(3), intrinsics(SIZE)
    with pytest.raises(ValueError, match="kernel 'round'"):
        rasterize(splats, np.eye(4), camera, SIZE, kernel="round")
    with pytest.raises(ValueError, match="backend 'gpu'"):
        rasterize(splats, np.eye(4), camera, SIZE, backend="gpu")
    with pytest.raises(ValueError, match="world_from_cam is not finite"):
        rasterize(splats, np.full((4, 4), np.nan), camera, SIZE)
    with pytest.raises(ValueError, match="intrinsics"):
        rasterize(splats, np.eye(4), camera[:3], SIZE)
    with pytest.raises(ValueError, match="0x5 pixels"):
        rasterize(splats, np.eye(4), camera, (0, 5))
    with pytest.raises(ValueError, match="exposure"):
        rasterize(splats, np.eye(4), camera, SIZE, exposure=torch.eye(3))
    with pytest.raises(ValueError, match="float64"):
        rasterize(copy(splats, torch.float64), np.eye(4), camera, SIZE, backend="cpu")
    splats.betas = splats.betas[:2]
    with pytest.raises(ValueError, match="betas"):
        rasterize(splats, np.eye(4), camera, SIZE)
