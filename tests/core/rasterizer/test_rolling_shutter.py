"""Renders as a rolling shutter sees them: against one render a line, between back ends, and by finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from mvsgs_core import geometry
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import POSE, assert_agree, copy, device_of, gradients, intrinsics, random_splats

READOUT = np.array([0.06, -0.04, 0.05, 0.03, -0.05, 0.04])  # 2 to 4 pixels at a depth of 2 to 5
BACKENDS = ("reference", "cpu", "triton")


def line_by_line(splats: Splats, lens: np.ndarray, size: tuple[int, int], readout: np.ndarray, axis: int) -> Tensor:
    """(H, W, 3) each row, or for axis 1 each column, from the pose at which it is read."""
    lines = []
    for line in range(size[axis]):
        pose = POSE @ geometry.se3_exp(readout * (line / size[axis] - 0.5))
        lines.append(rasterize(splats, pose, lens, size).color.select(axis, line))
    return torch.stack(lines, dim=axis)


@pytest.mark.parametrize(
    ("readout", "left"), [(READOUT, 0.1), (-READOUT, 0.1), *zip(np.eye(6) * 0.08, [0.1, 0.1, 0.45, 0.1, 0.1, 0.1])],
    ids=["all", "back", "x", "y", "z", "turn x", "turn y", "turn z"],
)  # fmt: skip
@pytest.mark.parametrize("reads_columns", [False, True])
def test_as_if_every_line_had_a_pose_of_its_own(reads_columns: bool, readout: np.ndarray, left: float) -> None:
    """left: of what the shutter changes, for it is of first order; ahead, what comes nearer grows as well, by 2 %."""
    splats, size, lens = random_splats(300, log_scale=-2.3), (48, 64), intrinsics((48, 64))
    if reads_columns:  # the same camera, held upright
        size, lens = (64, 48), lens[[1, 0, 3, 2]]
    splats.opacity_logits += 1.0
    expected = line_by_line(splats, lens, size, readout, int(reads_columns))
    found = rasterize(splats, POSE, lens, size, readout=readout, reads_columns=reads_columns).color
    without = rasterize(splats, POSE, lens, size).color
    assert float((found - expected).square().mean()) < left**2 * float((without - expected).square().mean())


@pytest.mark.parametrize("kernel", ["gaussian", "exact"])
@pytest.mark.parametrize("backend", ["cpu", pytest.param("triton", marks=pytest.mark.slow)])
def test_back_ends_agree_with_the_reference(backend: str, kernel: str) -> None:
    if backend == "triton":
        pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")
    count, size = (200, (40, 56)) if backend == "cpu" else (40, (20, 35))
    splats = random_splats(count, seed=1)  # with 0 a pixel's only splat lies within 1e-9 of 1/255: seen or not, on ARM
    assert_agree(splats, size, backend, kernel=kernel, antialiased=True, readout=READOUT)
    assert_agree(splats, size, backend, kernel=kernel, readout=20 * READOUT)  # beyond MAX_MOTION, most of them
    assert_agree(splats, size, backend, kernel=kernel, antialiased=True, readout=READOUT, reads_columns=True)


@pytest.mark.parametrize("reads_columns", [False, True])
def test_gradients_of_the_reference(reads_columns: bool) -> None:
    """Every element of the Jacobian in float64, that of the pose included."""
    scene = random_splats(4, 4, seed=7, log_scale=0.3)
    delta = torch.full((6,), 0.02, dtype=torch.float64, requires_grad=True)
    inputs = tuple(t[:2].double().requires_grad_() for t in scene.tensors().values())
    size = (5, 6)

    def images(*values: Tensor) -> tuple[Tensor, ...]:
        *fields, twist = values
        render = rasterize(
            Splats(*fields), POSE, intrinsics(size), size, backend="reference", pose_delta=twist, readout=2 * READOUT,
            reads_columns=reads_columns,
        )  # fmt: skip
        return render.color, render.depth, render.opacity

    assert torch.autograd.gradcheck(images, (*inputs, delta), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("reads_columns", [False, True])
def test_no_motion_is_no_shutter(backend: str, reads_columns: bool) -> None:
    if backend == "triton":
        pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")
    size, splats = (20, 24), random_splats(30)
    runs = [
        gradients(copy(splats, device=device_of(backend)), size, backend=backend, readout=readout, reads_columns=given)
        for readout, given in ((None, False), (np.zeros(6), reads_columns))
    ]
    assert torch.equal(runs[0][0].color, runs[1][0].color)
    assert all(torch.equal(value, runs[1][1][name]) for name, value in runs[0][1].items())


def test_what_is_no_twist_is_refused() -> None:
    with pytest.raises(ValueError, match="readout: expected 6 finite numbers"):
        rasterize(random_splats(1), POSE, intrinsics((4, 4)), (4, 4), readout=np.full(6, np.nan))
