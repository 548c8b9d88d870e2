"""Kernels that are called again and again, each time with a little more memory, until there is enough.

As a program, with the name of one: prints how often it raised MemoryError before.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from mvsgs_core import native

UNBOUND = resource.RLIM_INFINITY
# Memory comes as it is asked for and goes at once, whatever was there before.
ENVIRONMENT = {"MALLOC_MMAP_THRESHOLD_": "4096", "MALLOC_ARENA_MAX": "1"}
MARGIN = 500_000  # bytes: a stack has no other way to say that it cannot grow than to end the process
THREADS = 2


def some(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).random(shape, dtype=np.float32)


def cost_options() -> object:
    return native.load("mvs").CostOptions(
        name="zncc", radius=2, top_k=1, noise=1.0, contrast=8.0, intensity_weight=0.0, intensity_range=20.0,
        threads=THREADS,
    )  # fmt: skip


def pair(width: int) -> dict[str, np.ndarray]:
    stays = np.concatenate([np.eye(3).ravel(), np.zeros(3)])[None].astype(np.float32)
    return {"reference": some(8, width), "neighbors": some(1, 8, width), "warps": stays}


def cost_volume(width: int) -> Callable[[], object]:
    images, surface = pair(width), some(8, width)
    given = {**images, "first": surface, "step": surface, "hypotheses": 1, "options": cost_options()}
    return lambda: native.load("mvs").cost_volume(**given)


def view_correlation(width: int) -> Callable[[], object]:
    given = {**pair(width), "inverse_depth": some(8, width), "options": cost_options()}
    return lambda: native.load("mvs").view_correlation(**given)


def semi_global(width: int) -> Callable[[], object]:
    options = native.load("mvs").SmoothOptions(
        p1=0.1, p2=0.4, edge=12.0, break_steps=4.0, temperature=0.02, paths=8, threads=THREADS
    )
    cost, image = some(2, 3, width), some(2, width)
    return lambda: native.load("mvs").semi_global(cost, image, image, image, options)


def choose_surface(width: int) -> Callable[[], object]:
    options = native.load("mvs").ChooseOptions(p1=0.1, p2=0.4, edge=12.0, apart=0.1, threads=THREADS)
    cost, surfaces, image = some(2, 3, width), some(3, 2, width), some(2, width)
    return lambda: native.load("mvs").choose_surface(cost, surfaces, image, options)


def partition(width: int) -> Callable[[], object]:
    all_of_it = np.ones((16, width), bool)
    given = {
        "colors": some(16, width, 3), "weight": some(16, width), "left": some(16, width), "taken": all_of_it,
        "sure": all_of_it, "logarithm": np.ones((16, width)), "angle": 0.01, "depth_noise": 0.02, "price": 0.1,
        "threads": THREADS,
    }  # fmt: skip
    return lambda: native.load("mapping").partition(**given)


def bundle_adjust(cells: int) -> Callable[[], object]:
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 0.1
    pixels = 100.0 * some(2, 2, cells).astype(np.float64)
    given = {
        "poses": poses, "inverse_depth": 0.5 + some(2, cells).astype(np.float64), "pixels": pixels,
        "intrinsics": np.array([100.0, 100.0, 50.0, 50.0]), "source": np.array([0, 1], np.int32),
        "to": np.array([1, 0], np.int32), "target": pixels + 1.0, "information": np.ones((2, 2, cells)),
        "free_pose": np.array([0, 1], np.uint8), "free_depth": np.ones((2, cells), np.uint8),
        "damping": np.full((2, cells), 1e-6), "prior": None, "prior_weight": None, "free_focal": False, "robust": 0,
        "robust_scale": 1.0, "min_z": 1e-3, "min_inverse_depth": 1e-6, "steps": 1, "adaptive": False, "lm": 1e-4,
        "ep": 0.1, "tolerance": 0.0, "threads": THREADS,
    }  # fmt: skip
    return lambda: native.load("tracking").bundle_adjust(**given)


def render(count: int) -> Callable[[], object]:
    """Splats that all touch all tiles of a small image."""
    settings = SimpleNamespace(
        size=(16, 32), intrinsics=(20.0, 20.0, 16.0, 8.0), readout=(0.0,) * 6, exact=False, background=(0.0,) * 3,
        near=1e-3, antialiased=False, degree=0, weights=False, threads=THREADS,
    )  # fmt: skip
    ones = np.ones(count, np.float32)
    at, turn = np.array([0.0, 0.0, 1.0], np.float32), np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    splats = [
        np.tile(at, (count, 1)), np.full((count, 3), -3.0, np.float32), np.tile(turn, (count, 1)), -5.0 * ones,
        np.ones((count, 1, 3), np.float32), 2.0 * ones,
    ]  # fmt: skip
    images = {"color": some(16, 32, 3), "depth": some(16, 32), "opacity": some(16, 32), "radii": ones.copy()}
    given = {"settings": settings, "pose": np.eye(4), "splats": splats, **images}
    return lambda: native.load("rasterizer").forward(**given)


# kernel, its size, by how much memory grows, bytes
KERNELS: dict[str, tuple[Callable[[int], Callable[[], object]], int, int]] = {
    "cost_volume": (cost_volume, 10_000, 1_000_000),
    "view_correlation": (view_correlation, 10_000, 1_000_000),
    "semi_global": (semi_global, 40_000, 500_000),
    "choose_surface": (choose_surface, 40_000, 500_000),
    "partition": (partition, 4096, 200_000),
    "bundle_adjust": (bundle_adjust, 40_000, 1_000_000),
    "render": (render, 80_000, 500_000),
}


def refusals(call: Callable[[], object], more: int) -> int:
    """How often `call` is refused memory before there is enough; it is called once with all that there is."""
    call()
    count = 0
    while True:
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + MARGIN + count * more, UNBOUND))
        try:
            call()
            return count
        except MemoryError:
            count += 1
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (UNBOUND, UNBOUND))


if __name__ == "__main__":
    make, size, more = KERNELS[sys.argv[1]]
    print(refusals(make(size), more))
