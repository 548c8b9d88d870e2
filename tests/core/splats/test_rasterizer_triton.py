"""The Triton back end against the reference: on a GPU where there is one, else in Triton's interpreter."""

from __future__ import annotations

import os

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # read when triton is first imported
pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")

from mvsgs_core.splats import rasterizer
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.rasterizer import rasterize
from tests.core.splats.rasterizer_scenes import POSE, assert_agree, intrinsics, random_splats


@pytest.mark.parametrize("density", ["gaussian", "exact", "ges_scale"])
def test_random_scene(density: str) -> None:
    assert_agree(random_splats(40), (20, 35), "triton", density=density)


def test_full_pixels_end_and_tiles_left_out() -> None:
    splats, size = random_splats(60, bases=1, log_scale=-1.0), (20, 35)
    splats.opacity_logits += 6.0
    mask = torch.ones(rasterizer.tile_grid(size), dtype=torch.bool)
    mask[0, 1] = False
    assert_agree(splats, size, "triton", tile_mask=mask, antialiased=True)


def test_zero_splats() -> None:
    render = rasterize(Splats.empty(), POSE, intrinsics((9, 9)), (9, 9), backend="triton")
    assert not bool(render.opacity.any())


def test_not_finite() -> None:
    splats = random_splats(20)
    splats.means[0, 0] = torch.nan
    render = rasterize(splats, POSE, intrinsics((16, 16)), (16, 16), backend="triton")
    assert render.refused == 1
    assert bool(torch.isfinite(render.color).all())
