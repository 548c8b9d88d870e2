"""What the kernels are given: an array that they write into is theirs or refused, memory that is not there is said."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from mvsgs_core import native
from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.rasterize import rasterize
from tests.support.rasterizer_scenes import random_splats

ROWS, WIDTH = 5, 3


def adam(value: np.ndarray, first: np.ndarray, steps: np.ndarray, gradient: np.ndarray | None = None) -> None:
    second = np.zeros((ROWS, WIDTH), np.float32)
    given = np.ones((ROWS, WIDTH), np.float32) if gradient is None else gradient
    group = (value, given, first, second, 0.1, 0.1, -1e9, 1e9, WIDTH, 1.0)
    native.load("mapping").adam([group], np.ones(ROWS, bool), steps, 0.9, 0.999, 1e-8, 100, 1)


def test_a_step_is_made_in_the_arrays_that_were_given_or_refused() -> None:
    def zeros() -> np.ndarray:
        return np.zeros((ROWS, WIDTH), np.float32)

    value, first, steps = zeros(), zeros(), np.zeros(ROWS, np.int32)
    adam(value, first, steps, np.broadcast_to(np.float32(1.0), (ROWS, WIDTH)))  # it is only read
    assert (value < 0).all()
    assert (first > 0).all()
    assert (steps == 1).all()
    apart = np.zeros((ROWS, 2 * WIDTH), np.float32)[:, ::2]
    frozen = zeros()
    frozen.setflags(write=False)
    for wrong in (apart, zeros().astype(np.float64), np.asfortranarray(zeros()), frozen):
        with pytest.raises(TypeError, match="incompatible function arguments"):
            adam(wrong, zeros(), steps)
        with pytest.raises(TypeError, match="incompatible function arguments"):
            adam(zeros(), wrong, steps)
    with pytest.raises(TypeError, match="dtype=int32"):
        adam(zeros(), zeros(), steps.astype(np.int64))


def test_the_loss_gradient_is_left_in_the_array_that_was_given_or_refused() -> None:
    image = torch.rand((8, 8, 3)).numpy()
    losses = native.load("rasterizer")
    for wrong in (np.zeros((8, 8, 3)), np.zeros((8, 16, 3), np.float32)[:, ::2]):
        with pytest.raises(TypeError, match="incompatible function arguments"):
            losses.image_loss(image, image[::-1], None, 0.8, 0.2, wrong, 1)


def test_splats_are_stepped_in_the_arrays_that_were_given_or_refused() -> None:
    """Through lists and tuples too."""
    state = MapState(1, torch.device("cpu"))
    state.append(random_splats(20, bases=1), torch.zeros(20, dtype=torch.int64))
    groups = optimizer.groups(optimizer.OptimizerConfig(), 1.0, 1.0, False, "gaussian", widest_new=None)

    def step() -> None:
        taken = optimizer.splat_step(state, groups, 100)
        camera = np.array([20.0, 20.0, 10.0, 8.0])
        found = rasterize(state.splats, np.eye(4), camera, (16, 20), backend="cpu", step=taken)
        found.color.sum().backward()

    step()
    assert int(state.steps.max()) == 1
    state.first["means"] = torch.zeros((20, 6))[:, ::2]
    with pytest.raises(TypeError, match="incompatible function arguments"):
        step()


SCRIPT = """
import resource, numpy as np, torch
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats

def wide(count):  # each on every tile
    ones = torch.ones(count)
    return Splats(torch.tensor([[0.0, 0.0, 1.0]]).repeat(count, 1), 3 * torch.ones(count, 3),
                  torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1), ones, torch.ones(count, 1, 3), 2 * ones)

def render(count):
    camera = np.array([900.0, 900.0, 960.0, 540.0])
    return rasterize(wide(count), np.eye(4), camera, (1080, 1920), backend="cpu", threads=2)

render(1)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 200_000_000, resource.RLIM_INFINITY))
try:
    render(20_000)
    print("no limit was met")
except MemoryError:
    print("said")
print(float(render(1).color.mean()) > 0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="its memory is bounded as Linux bounds it")
def test_a_view_that_takes_more_memory_than_there_is_ends_no_process() -> None:
    found = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
    assert found.stdout.split("\n")[:2] == ["said", "True"]
