"""Speed of the rasterizer: beside plain C++ loops, beside its PyTorch reference, and against the machine's peaks.

    python -m bench.rasterizer [--quick] [--json FILE]

Scenes are random: splats spread evenly over the view, about 10 px in radius, half of them seen through others, color by
spherical harmonics of degree 0; the gradient is of the color. Everything that is compared runs in turns, one after the
other in every round, and medians are over the rounds.

Roofline: projection and lists take at least their traffic to memory at the rate of a copy; blending takes at least
its densities (squared distance and exponential) at the rate reached in registers, or its updates of the tiles at the
rate of the first-level cache, whichever is longer. The sum of both, at rates measured here with the same threads.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from dataclasses import dataclass, field

import numpy as np
import torch

from bench.table import Row, at_least, at_most, main
from mvsgs_core import native
from mvsgs_core.datasets import open_dataset
from mvsgs_core.splats import densities, spherical_harmonics, ssim
from mvsgs_core.splats.densities import DENSITIES
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.rasterizer import rasterize

SPEEDUP = 4.0  # over the plain loops
ROOFLINE = 35.0  # %
FORWARD_VECTORS, BACKWARD_VECTORS = 10, 10  # 64-byte loads and stores of a tile's state per block and splat
MARKS = {(240, "gaussian"): 32.0, (480, "gaussian"): 108.0, (240, "exact"): 73.6, (480, "exact"): 248.0}  # ms


@dataclass
class Times:
    """Seconds of each round."""

    forward: list[float] = field(default_factory=list)
    backward: list[float] = field(default_factory=list)

    def add(self, forward: float, backward: float) -> None:
        self.forward.append(forward)
        self.backward.append(backward)

    def milliseconds(self) -> tuple[float, float]:
        return 1e3 * statistics.median(self.forward), 1e3 * statistics.median(self.backward)

    def total(self) -> float:
        return sum(self.milliseconds())


def scene(count: int, width: int, density: str) -> Splats:
    """`count` splats over the view of a camera at the origin with a focal length of 0.9 widths, aspect 4:3."""
    g = torch.Generator().manual_seed(0)
    across = torch.rand(count, 2, generator=g) - 0.5
    z = 1.0 + 3.0 * torch.rand(count, generator=g)
    means = torch.stack([across[:, 0] * z / 0.9, across[:, 1] * z * 0.75 / 0.9, z], dim=1)
    log_scales = torch.log(2.56 * z / width)[:, None] + 0.5 * torch.randn(count, 3, generator=g)
    betas = torch.rand(count, generator=g) * 2.0 + 1.0
    splats = Splats(
        means=means,
        log_scales=log_scales,
        quaternions=torch.randn(count, 4, generator=g),
        opacity_logits=torch.randn(count, generator=g),
        sh=torch.randn(count, 1, 3, generator=g) * 0.5,
        betas=betas if density == "exact" else torch.zeros(count),
    )
    return Splats(*(tensor.requires_grad_() for tensor in splats.tensors().values()))


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    height, width = size
    return np.array([0.9 * width, 0.9 * width, 0.5 * width - 0.5, 0.5 * height - 0.5])


def run(splats: Splats, size: tuple[int, int], density: str, backend: str, threads: int, times: Times) -> torch.Tensor:
    """One forward and backward pass, timed."""
    gradient = torch.ones(*size, 3)
    start = time.perf_counter()
    render = rasterize(splats, np.eye(4), intrinsics(size), size, density=density, backend=backend, threads=threads)
    middle = time.perf_counter()
    render.color.backward(gradient)
    times.add(middle - start, time.perf_counter() - middle)
    return render.color.detach()


def run_baseline(splats: Splats, size: tuple[int, int], density: str, threads: int, times: Times) -> torch.Tensor:
    color = torch.empty(*size, 3)
    seconds = native.load("splats").baseline(
        *(tensor.detach() for tensor in splats.tensors().values()), torch.eye(4, dtype=torch.float64),
        tuple(intrinsics(size).tolist()), density == "exact", threads, color, torch.ones(*size, 3),
        torch.empty(len(splats), 9),
    )  # fmt: skip
    times.add(*seconds)
    return color


def work(splats: Splats, size: tuple[int, int], density: str) -> tuple[int, int]:
    """(densities evaluated by the forward pass, pairs of splats and tiles)."""
    height, width = size
    passed = native.load("splats").forward(
        *(tensor.detach() for tensor in splats.tensors().values()), pose=torch.eye(4, dtype=torch.float64),
        intrinsics=tuple(intrinsics(size).tolist()), near=1e-3, background=(0.0, 0.0, 0.0), exact=density == "exact",
        antialiased=False, degree=0, tile_mask=None, weights=False, threads=0, color=torch.empty(height, width, 3),
        depth=torch.empty(size), opacity=torch.empty(size), radii=torch.empty(len(splats)),
    )  # fmt: skip
    return passed.exponentials, passed.pairs


def roofline(splats: Splats, size: tuple[int, int], density: str, threads: int) -> float:
    """Milliseconds that forward and backward would take at the machine's peaks."""
    kernels = native.load("splats")
    evaluated, pairs = work(splats, size, density)
    vectors = (FORWARD_VECTORS + BACKWARD_VECTORS) * evaluated // 16
    # splats: parameters read twice, gradients written, projection written and read twice; pairs written and read with
    # their splat, sums written and read; images
    traffic = len(splats) * (2 * 60 + 60 + 3 * 64) + pairs * (4 * 12 + 2 * 64 + 2 * 64) + size[0] * size[1] * 4 * 13
    blending = max(
        2 * evaluated / kernels.peak_densities(density == "exact", threads),
        64 * vectors / kernels.peak_tile_bytes(threads),
    )
    return 1e3 * (blending + traffic / kernels.peak_memory_bytes(threads))


def compare(size: tuple[int, int], count: int, threads: int, rounds: int) -> list[Row]:
    """C++ kernel, plain loops and roofline at one size, and what the density forms cost."""
    rows = []
    totals = {}
    for density in DENSITIES:
        splats = scene(count, size[1], density)
        fast, plain, one = Times(), Times(), Times()
        for i in range(rounds):
            image = run(splats, size, density, "cpu", threads, fast)
            if density != "ges_scale" and i % 4 == 0:
                other = run_baseline(splats, size, density, threads, plain)
                run(splats, size, density, "cpu", 1, one)
        forward, backward = fast.milliseconds()
        totals[density] = fast.total()
        label = f"{size[1]}x{size[0]} {count // 1000}k {density}"
        rows += [Row(f"{label}: forward", forward, "ms"), Row(f"{label}: backward", backward, "ms")]
        if density == "ges_scale":
            continue
        rows += [
            at_most(f"{label}: both", totals[density], "ms", MARKS[size[0], density]),
            Row(f"{label}: plain loops, forward", plain.milliseconds()[0], "ms"),
            Row(f"{label}: plain loops, backward", plain.milliseconds()[1], "ms"),
            at_least(f"{label}: times faster than plain loops", plain.total() / totals[density], "x", SPEEDUP),
            Row(f"{label}: mean difference to plain loops", float((image - other).abs().mean()), ""),
            Row(f"{label}: times faster than with 1 thread", one.total() / totals[density], "x"),
        ]
        bound = roofline(splats, size, density, threads)
        rows += [
            Row(f"{label}: roofline", bound, "ms"),
            at_least(f"{label}: share of the roofline", 100.0 * bound / totals[density], "%", ROOFLINE),
        ]
    for density in DENSITIES[1:]:
        price = totals[density] / totals["gaussian"]
        rows.append(Row(f"{size[1]}x{size[0]}: price of {density} over gaussian", price, "x"))
    return rows


def beside_reference(threads: int) -> list[Row]:
    """The PyTorch reference on a small scene."""
    size, rows = (48, 64), []
    for density in ("gaussian", "exact"):
        splats, slow, fast = scene(1000, size[1], density), Times(), Times()
        for _ in range(3):
            run(splats, size, density, "reference", threads, slow)
            run(splats, size, density, "cpu", threads, fast)
        rows.append(Row(f"64x48 1k {density}: reference, both", slow.total(), "ms"))
        rows.append(Row(f"64x48 1k {density}: times faster than the reference", slow.total() / fast.total(), "x"))
    return rows


def similarity() -> list[Row]:
    """SSIM with its gradient at 320x240, one thread."""
    g = torch.Generator().manual_seed(0)
    image, target = (torch.rand(240, 320, 3, generator=g) for _ in range(2))
    image.requires_grad_()
    fused, twin = [], []
    for i in range(24):
        start = time.perf_counter()
        ssim.ssim(image, target, threads=1).backward()
        fused.append(time.perf_counter() - start)
        if i < 3:
            start = time.perf_counter()
            ssim.ssim_reference(image, target).backward()
            twin.append(time.perf_counter() - start)
    milliseconds = 1e3 * statistics.median(fused)
    return [
        at_most("SSIM and gradient, 320x240, 1 thread", milliseconds, "ms", 8.0),
        Row("SSIM: times faster than PyTorch", 1e3 * statistics.median(twin) / milliseconds, "x"),
    ]


def fit(image: torch.Tensor, camera: np.ndarray, density: str, seconds: float) -> tuple[float, int]:
    """(PSNR, iterations) of 3,000 splats fitted to one image in `seconds` of one core."""
    height, width = image.shape[:2]
    g = torch.Generator().manual_seed(0)
    pixels = torch.rand(3000, 2, generator=g) * torch.tensor([width, height])
    z = 2.0 + torch.rand(3000, generator=g)
    rays = (pixels - torch.from_numpy(camera[2:]).float()) / torch.from_numpy(camera[:2]).float()
    colors = image[pixels[:, 1].long(), pixels[:, 0].long()]
    splats = Splats(
        means=torch.cat([rays, torch.ones(3000, 1)], dim=1) * z[:, None],
        log_scales=torch.log(3.0 * z / float(camera[0]))[:, None].repeat(1, 3),
        quaternions=torch.randn(3000, 4, generator=g),
        opacity_logits=torch.full((3000,), -1.0),
        sh=spherical_harmonics.from_rgb(colors)[:, None],
        betas=torch.full((3000,), densities.neutral_beta(density)),
    )
    leaves = [tensor.requires_grad_() for tensor in splats.tensors().values()]
    rates = (2e-3, 5e-3, 1e-3, 5e-2, 1e-2, 1e-2)
    adam = torch.optim.Adam([{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates)], eps=1e-15)
    start, iterations, render = time.process_time(), 0, None
    while time.process_time() - start < seconds or render is None:
        render = rasterize(splats, np.eye(4), camera, (height, width), density=density, threads=1)
        adam.zero_grad()
        ssim.image_loss(render.color, image, l1_weight=0.8, ssim_weight=0.2, threads=1).backward()
        adam.step()
        iterations += 1
    error = (render.color.detach().clamp(0.0, 1.0) - image).square().mean()
    return -10.0 * math.log10(error.item()), iterations


def worth(seconds: float) -> list[Row]:
    """What each density form reaches in the same time: one view of the synthetic room, one core."""
    rows = []
    item = next(iter(open_dataset("synthetic", size=(240, 320))))
    image = torch.from_numpy(item.image.copy()).float() / 255.0
    for density in densities.DENSITIES:
        psnr, iterations = fit(image, item.intrinsics, density, seconds)
        rows.append(Row(f"one view, {seconds:g} s of one core, {density}: PSNR", psnr, "dB"))
        rows.append(Row(f"one view, {seconds:g} s of one core, {density}: iterations", float(iterations), ""))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    threads = options.threads
    rounds = 9 if options.quick else 25
    rows = compare((240, 320), 20_000, threads, rounds)
    rows += compare((480, 640), 50_000, threads, rounds)
    return rows + beside_reference(threads) + similarity() + worth(2.0 if options.quick else 8.0)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, default=2, help="of the kernel, the plain loops and the peaks")


if __name__ == "__main__":
    main(measure, "rasterizer", arguments)
