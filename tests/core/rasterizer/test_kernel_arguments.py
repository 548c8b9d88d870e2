"""What the kernels are given: an array that they write into is theirs or refused, memory that is not there is said."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core import native
from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.rasterize import rasterize
from tests.support.rasterizer_scenes import kernel_pass, random_splats, wide_splats
from tests.support.shared_data import ROOT

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


def test_what_counts_the_steps_is_as_long_as_the_splats() -> None:
    state = MapState(1, torch.device("cpu"))
    state.append(random_splats(20, bases=1), torch.zeros(20, dtype=torch.int64))
    groups = optimizer.groups(optimizer.OptimizerConfig(), 1.0, 1.0, False, "gaussian", widest_new=None)
    camera = np.array([20.0, 20.0, 10.0, 8.0])
    for name in ("ages", "means2d_gradient", "means2d_views"):
        taken = optimizer.splat_step(state, groups, 100)
        setattr(taken, name, getattr(taken, name)[:19].clone())
        found = rasterize(state.splats, np.eye(4), camera, (16, 20), backend="cpu", step=taken)
        with pytest.raises(ValueError, match="differ in length from the splats"):
            found.color.sum().backward()
    assert not state.steps.any()


CAMERA, SIZE = np.array([900.0, 900.0, 960.0, 540.0]), (1080, 1920)
TILES = 120 * 68


def test_a_view_of_too_many_pairs_is_refused() -> None:
    given: Any = (wide_splats(20), np.eye(4), CAMERA, SIZE)
    for too_many in (1000, 20 * TILES):
        with pytest.raises(ValueError, match=f"{too_many} pairs of splats and tiles or more: take fewer"):
            kernel_pass(*given, max_pairs=too_many)
    assert kernel_pass(*given, max_pairs=20 * TILES + 1).pairs == kernel_pass(*given).pairs == 20 * TILES


SCRIPT = """
import resource, numpy as np
from tests.support.rasterizer_scenes import kernel_pass, wide_splats

def pairs(count, **options):
    camera = np.array([900.0, 900.0, 960.0, 540.0])
    return kernel_pass(wide_splats(count), np.eye(4), camera, (1080, 1920), **options).pairs

def bound(extra):
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + extra, resource.RLIM_INFINITY))

pairs(1)
bound(200_000_000)
try:
    pairs(20_000)
    print("no limit was met")
except MemoryError:
    print("said")
print(pairs(1))
bound(400_000_000)
try:
    pairs(20_000, max_pairs=1_000_000)  # they would take 1 GB
except ValueError:
    print("refused before")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="its memory is bounded as Linux bounds it")
def test_a_view_that_takes_more_memory_than_there_is_ends_no_process() -> None:
    found = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
    assert found.stdout.split("\n")[:3] == ["said", str(TILES), "refused before"]
