"""The fast back end against the float64 reference, value by value and gradient by gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.rasterizer.kernels import KERNELS
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import POSE, assert_agree, copy, gradients, intrinsics, random_splats

BACKEND = "cpu"


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_random_scene(kernel: str, bases: int) -> None:
    assert_agree(random_splats(200, bases, seed=bases), (40, 56), BACKEND, kernel=kernel)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_antialiased(kernel: str) -> None:
    small = random_splats(300, log_scale=-4.5)
    assert_agree(small, (40, 56), BACKEND, kernel=kernel, antialiased=True)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (17, 31), (16, 16)])
def test_sizes_that_are_no_multiple_of_a_tile(size: tuple[int, int]) -> None:
    assert_agree(random_splats(80, log_scale=-2.0), size, BACKEND)


def test_many_splats_on_one_tile() -> None:
    splats = random_splats(10_000, bases=1, log_scale=-4.0)
    splats.opacity_logits -= 4.0
    assert_agree(splats, (12, 15), BACKEND)


def test_full_pixels_end() -> None:
    opaque = random_splats(400, bases=1, log_scale=-1.0)
    opaque.opacity_logits += 6.0
    assert_agree(opaque, (40, 56), BACKEND)


@pytest.mark.parametrize("bases", [1, 4])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 47])
def test_groups_of_sixteen_splats_and_the_rest(count: int, bases: int) -> None:
    assert_agree(random_splats(count, bases), (40, 56), BACKEND)


def test_needles_and_discs() -> None:
    splats = random_splats(150, log_scale=-3.0)
    splats.log_scales[:50, 0] += 4.0
    splats.log_scales[50:100, 1] -= 9.0
    assert_agree(splats, (40, 56), BACKEND)


def test_close_to_the_camera_and_off_to_the_side() -> None:
    splats = random_splats(200, log_scale=-2.5)
    splats.means[:, 2] -= 2.0
    splats.means[:, :2] *= 2.0
    assert_agree(splats, (40, 56), BACKEND, near=0.05)


@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
def test_threads_and_repetition_change_nothing(kernel: str) -> None:
    splats, size = random_splats(3000), (120, 100)
    first, expected = gradients(copy(splats), size, backend=BACKEND, kernel=kernel, threads=1)
    for threads in (1, 2, 3):
        render, found = gradients(copy(splats), size, backend=BACKEND, kernel=kernel, threads=threads)
        for name in ("color", "depth", "opacity", "weight_max", "radii"):
            assert torch.equal(getattr(render, name), getattr(first, name)), name
        for name, wanted in expected.items():
            assert torch.equal(found[name], wanted), name


def test_equal_depths_blend_in_the_order_of_the_index() -> None:
    splats = random_splats(2, bases=1)
    splats.means[:] = torch.tensor([0.0, 0.0, 3.0])
    splats.log_scales[:] = -1.0
    splats.opacity_logits[:] = 2.0
    splats.sh[0], splats.sh[1] = 1.5, -1.5
    size = (9, 9)
    for backend in ("cpu", "reference"):
        render = rasterize(splats, np.eye(4), intrinsics(size), size, backend=backend)
        other = rasterize(
            Splats(*(t.flip(0) for t in splats.tensors().values())), np.eye(4), intrinsics(size), size, backend=backend
        )
        assert float(render.color[4, 4, 0]) > float(other.color[4, 4, 0]) + 0.3


@pytest.mark.slow
def test_gradients_far_from_the_origin() -> None:
    """Means relative to a near origin, the pose far away together with them: only differences count."""
    splats, size = random_splats(200), (40, 56)
    splats.means = torch.round(splats.means * 1024) / 1024
    shift = torch.tensor([4096.0, -2048.0, 1024.0])  # exact in float32 beside 1/1024
    far_pose = POSE.copy()
    far_pose[:3, 3] += shift.numpy()
    far = Splats(splats.means + shift, *list(splats.tensors().values())[1:])
    near_render = rasterize(splats, POSE, intrinsics(size), size, backend=BACKEND)
    far_render = rasterize(far, far_pose, intrinsics(size), size, backend=BACKEND)
    torch.testing.assert_close(near_render.color, far_render.color, rtol=0, atol=1e-5)


def test_the_largest_weight_of_one_opaque_splat() -> None:
    splats = random_splats(1, bases=1)
    splats.means[0] = torch.tensor([0.0, 0.0, 2.0])
    splats.log_scales[0] = 3.0
    splats.opacity_logits[0] = 20.0
    size = (20, 20)
    render = rasterize(splats, np.eye(4), intrinsics(size), size, backend=BACKEND, weights=True)
    assert render.weight_max is not None
    assert float(render.weight_max[0]) == pytest.approx(0.99, abs=1e-6)
