"""The Triton back end against the other two: on a GPU where there is one, else in Triton's interpreter."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mvsgs_core.rasterizer.rasterize import Render, rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import (
    POSE,
    assert_agree,
    assert_finite,
    copy,
    device_of,
    extremes,
    gradients,
    intrinsics,
    kernel_pass,
    random_splats,
    relative_error,
    render_settings,
)

pytestmark = [pytest.mark.slow, pytest.mark.gpu]

pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")

SIZE = (20, 35)
DEVICE = device_of("triton")


@pytest.mark.parametrize("kernel", ["gaussian", "exact", "ges_scale"])
def test_random_scene(kernel: str) -> None:
    assert_agree(random_splats(40), SIZE, "triton", kernel=kernel)


def test_harmonics_of_degree_three() -> None:
    assert_agree(random_splats(30, bases=16), SIZE, "triton", antialiased=True)


def test_full_pixels_end() -> None:
    splats = random_splats(30, bases=1, log_scale=-1.0)
    splats.opacity_logits += 6.0
    assert_agree(splats, SIZE, "triton", antialiased=True)


def needles(count: int) -> Splats:
    """Splats of many tiles, most of them long and thin and across the rows."""
    splats = random_splats(count, bases=1, log_scale=-4.0)
    splats.log_scales[:, 0] = torch.linspace(-4.0, 0.5, count)
    return splats


def pairs_of(splats: Splats, size: tuple[int, int], kernel: str) -> tuple[int, int]:
    """(pairs that the C++ kernel blends, pairs in the Triton lists of all tiles)."""
    from mvsgs_core.rasterizer.triton import backend as triton_backend

    settings = render_settings(POSE, intrinsics(size), size, kernel)
    passed = kernel_pass(splats, POSE, intrinsics(size), size, kernel)
    parameters = list(splats.tensors().values())
    lists = triton_backend.projected([tensor.to(DEVICE) for tensor in parameters], settings).lists
    return passed.pairs, int(lists.tile_begin[-1])


@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_as_many_pairs_as_the_kernel_for_cpus(kernel: str) -> None:
    """Exact spans of the ellipses on each row of blocks, no boxes."""
    size = (70, 90)
    for splats in (random_splats(80, bases=1), needles(40)):
        expected, listed = pairs_of(splats, size, kernel)
        assert listed == expected > 100


def test_the_same_every_time() -> None:
    runs = [gradients(copy(needles(20), device=DEVICE), SIZE, backend="triton") for _ in range(2)]
    assert all(torch.equal(found, runs[1][1][name]) for name, found in runs[0][1].items())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's, of the interpreter: overflow is what is provoked here
@pytest.mark.parametrize(
    "name",
    [
        "zero quaternions", "scales from 1e-12 to 1e6", "scales beyond float32", "aspect 1:1e5", "opacity 0 and 1",
        "exponents out of range", "at and behind the near plane", "in the camera", "far away",
    ],
)  # fmt: skip
def test_extremes(name: str) -> None:
    options: dict[str, Any] = {"kernel": "exact", "antialiased": True}
    splats = Splats(*(tensor[::2] for tensor in extremes(name).tensors().values()))
    render, found = gradients(copy(splats, device=DEVICE), SIZE, backend="triton", **options)
    truth, expected = gradients(copy(splats), SIZE, backend="cpu", **options)
    assert_finite(render, found)
    assert render.refused == truth.refused
    assert bool((render.visible.cpu() == truth.visible).all())
    assert float((render.color.cpu() - truth.color).detach().abs().max()) < 1e-3
    for key in ("sh", "exposure"):
        assert relative_error(found[key], expected[key]) < 1e-2, key


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_parameters_that_are_not_finite() -> None:
    splats = random_splats(20)
    for i, tensor in enumerate(splats.tensors().values()):
        tensor[2 * i].view(-1)[0] = torch.nan
        tensor[2 * i + 1].view(-1)[-1] = torch.inf
    render, found = gradients(copy(splats, device=DEVICE), SIZE, backend="triton")
    assert render.refused == 12
    assert_finite(render, found)
    assert all(bool((found[name][:12] == 0).all()) for name in ("means", "sh", "means2d"))


def render_of(splats: Splats, size: tuple[int, int]) -> Render:
    return rasterize(splats, POSE, intrinsics(size), size, backend="triton", weights=True)


def test_zero_splats_nothing_in_view_and_one_pixel() -> None:
    empty = copy(Splats.empty(4), device=DEVICE)
    render = render_of(empty, (9, 9))
    assert not bool(render.opacity.any())
    render.color.sum().backward()
    assert empty.sh.grad is not None
    assert empty.sh.grad.shape == (0, 4, 3)
    behind = copy(random_splats(5), device=DEVICE)
    behind.means = -behind.means
    assert not bool(render_of(behind, (9, 9)).visible.any())
    assert_agree(random_splats(50, log_scale=0.0), (1, 1), "triton")
