"""Speed of the rasterizer: beside plain C++ loops, beside its PyTorch reference, and against the machine's peaks.

    python -m bench.rasterizer [--quick] [--json FILE]

Scenes are random: splats spread evenly over the view, about 10 px in radius, half of them seen through others, color by
spherical harmonics of degree 0; the gradient is of the color. Everything that is compared runs in turns, one after the
other in every round, the peaks of the machine too; a figure is the median of the rounds, with their spread, and a goal
is met where the whole spread meets it.

Roofline: what an ideal implementation needs at the peaks measured here with the same threads, the sum of

- blending: the arithmetic of `Operations` for every pair of splat and pixel that gets color (no lane wasted, nothing
  looked at in vain), each operation at the rate of a multiplication with addition in registers; or the reads and writes
  of the tiles' state in the first-level cache where those take longer;
- projection forward and backward, at the same rate;
- traffic to memory of parameters, gradients, pairs, sums and images, at the rate of a copy.

Sorting and finding tiles count by their traffic alone. Beside it, the fraction if every lane that the kernel evaluates
counted (4x4 pixels go together), and a simpler estimate of exponentials and bytes: the values of the splats' kernels
at their own rate, no other arithmetic.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from dataclasses import dataclass, field

import numpy as np
import torch

from bench.table import Row, at_most, main, timed
from mvsgs_core import camera, native
from mvsgs_core.datasets import open_dataset
from mvsgs_core.rasterizer import kernels, spherical_harmonics, ssim
from mvsgs_core.rasterizer.kernels import KERNELS
from mvsgs_core.rasterizer.rasterize import RenderSettings, rasterize
from mvsgs_core.rasterizer.splats import Splats

PASSES = 3  # of the kernel in a round, with one thread as with several
SPEEDUP = 4.0  # over the plain loops
ROOFLINE = 35.0  # %
FORWARD_VECTORS, BACKWARD_VECTORS = 10, 10  # 64-byte loads and stores of a tile's state per block and splat
PROJECTION_OPERATIONS = 540  # per splat: 190 to the image; as much again without colors, and the chain rule, back
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


def scene(count: int, width: int, kernel: str) -> Splats:
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
        betas=betas if kernel == "exact" else torch.zeros(count),
    )
    return Splats(*(tensor.requires_grad_() for tensor in splats.tensors().values()))


def intrinsics(size: tuple[int, int]) -> np.ndarray:
    height, width = size
    return np.array([0.9 * width, 0.9 * width, 0.5 * width - 0.5, 0.5 * height - 0.5])


def run(
    splats: Splats, size: tuple[int, int], kernel: str, backend: str, threads: int, times: Times,
    antialiased: bool = False,
) -> torch.Tensor:  # fmt: skip
    """One forward and backward pass, timed."""
    gradient = torch.ones(*size, 3)
    start = time.perf_counter()
    render = rasterize(
        splats, np.eye(4), intrinsics(size), size, kernel=kernel, backend=backend, threads=threads,
        antialiased=antialiased,
    )  # fmt: skip
    middle = time.perf_counter()
    render.color.backward(gradient)
    times.add(middle - start, time.perf_counter() - middle)
    return render.color.detach()


def render_settings(size: tuple[int, int], kernel: str, threads: int) -> RenderSettings:
    """As the C++ kernels take them, with the blending weights, which count what contributed."""
    return RenderSettings(
        pose=torch.eye(4, dtype=torch.float64), intrinsics=tuple(intrinsics(size).tolist()), size=size,
        readout=(0.0,) * 6, exact=kernel == "exact", background=(0.0, 0.0, 0.0), near=1e-3, antialiased=False,
        degree=0, weights=True, threads=threads,
    )  # fmt: skip


def arrays(splats: Splats) -> list[torch.Tensor]:
    return [tensor.detach() for tensor in splats.tensors().values()]


def run_baseline(splats: Splats, size: tuple[int, int], kernel: str, threads: int, times: Times) -> torch.Tensor:
    color = torch.empty(*size, 3)
    settings = render_settings(size, kernel, threads)
    seconds = native.load("bench").baseline(
        settings, settings.pose, arrays(splats), color, torch.ones(*size, 3), torch.empty(len(splats), 9)
    )
    times.add(*seconds)
    return color


@dataclass(frozen=True)
class Operations:
    """Arithmetic per pair of splat and pixel; a multiplication with addition is one, a comparison or selection is one.

    Kernel: u, v 3, log2 of alpha 2, exponential 8 (two to split, five products, one to scale); the exact form adds the
    logarithm 13, the exponential 8, their limits 2 and the exponent 1. Forward: clamp, two comparisons, weight,
    transmittance, four sums. Backward: clamp, two comparisons, weight, transmittance, three for dL/dweight, one for
    what lies behind, seven for dL/dalpha (its reciprocal is three), eleven for the sums; the exact form adds eight.
    """

    kernel: int
    forward: int = 9
    backward: int = 27

    def pair(self) -> int:
        """Of the forward and the backward pass: both evaluate the kernel, for keeping it costs more bytes."""
        return 2 * self.kernel + self.forward + self.backward


OPERATIONS = {"gaussian": Operations(13), "exact": Operations(37, backward=35)}


@dataclass(frozen=True)
class Work:
    """What the kernel did in one forward pass."""

    evaluated: int  # values of the splats' kernels, lanes off the ellipse included
    contributed: int  # of those, pairs of splat and pixel that got color
    pairs: int  # of splats and tiles


def work(splats: Splats, size: tuple[int, int], kernel: str) -> Work:
    settings = render_settings(size, kernel, threads=0)
    passed = native.load("rasterizer").forward(
        settings, settings.pose, arrays(splats), color=torch.empty(*size, 3), depth=torch.empty(size),
        opacity=torch.empty(size), radii=torch.empty(len(splats)),
    )  # fmt: skip
    return Work(passed.evaluated, passed.contributed, passed.pairs)


@dataclass(frozen=True)
class Roofline:
    """Milliseconds that forward and backward would take at the machine's peaks."""

    necessary: float  # all necessary arithmetic of the pairs that contribute, and bytes
    evaluated: float  # the same for every lane that is evaluated
    simple: float  # exponentials and bytes


def roofline(done: Work, count: int, size: tuple[int, int], kernel: str, threads: int) -> Roofline:
    peaks = native.load("bench")
    products = peaks.peak_products(threads)
    cache = peaks.peak_tile_bytes(threads)
    # splats: parameters read twice, gradients written, projection written and read twice; pairs written and read with
    # their splat, sums written and read; images
    traffic = count * (2 * 60 + 60 + 3 * 64) + done.pairs * (4 * 12 + 2 * 64 + 2 * 64) + size[0] * size[1] * 4 * 13
    memory = traffic / peaks.peak_memory_bytes(threads)

    def state(pairs: int) -> float:
        return 64 * (FORWARD_VECTORS + BACKWARD_VECTORS) * pairs / 16 / cache

    def bound(pairs: int) -> float:
        blending = max(pairs * OPERATIONS[kernel].pair() / products, state(pairs))
        return 1e3 * (blending + count * PROJECTION_OPERATIONS / products + memory)

    kernel_only = 2 * done.evaluated / peaks.peak_kernel_values(kernel == "exact", threads)
    simple = 1e3 * (max(kernel_only, state(done.evaluated)) + memory)
    return Roofline(bound(done.contributed), bound(done.evaluated), simple)


@dataclass
class Round:
    """What is compared, measured in turns: medians of a few passes each, and the peaks of the machine right after."""

    fast: Times = field(default_factory=Times)
    plain: Times = field(default_factory=Times)
    one: Times = field(default_factory=Times)  # thread
    bound: Roofline | None = None
    alone: Roofline | None = None  # with one thread

    def fraction(self, which: str = "necessary") -> float:
        """Of the roofline, %."""
        return 100.0 * float(getattr(self.bound, which)) / self.fast.total()

    def fraction_alone(self) -> float:
        assert self.alone is not None
        return 100.0 * self.alone.necessary / self.one.total()


def compare(size: tuple[int, int], count: int, threads: int, rounds: int) -> list[Row]:
    """C++ kernel, plain loops and roofline at one size, and what the kernels cost."""
    rows = []
    totals = {}
    for kernel in KERNELS:
        splats = scene(count, size[1], kernel)
        done = work(splats, size, kernel)
        measured = [Round() for _ in range(rounds)]
        for each in measured:
            for _ in range(PASSES):  # with one thread in turns, so that both find the caches as the other left them
                image = run(splats, size, kernel, "cpu", threads, each.fast)
                if kernel != "ges_scale":
                    run(splats, size, kernel, "cpu", 1, each.one)
            if kernel != "ges_scale":
                other = run_baseline(splats, size, kernel, threads, each.plain)
                each.bound = roofline(done, count, size, kernel, threads)
                each.alone = roofline(done, count, size, kernel, 1)
        both = [each.fast.total() for each in measured]
        totals[kernel] = statistics.median(both)
        label = f"{size[1]}x{size[0]} {count // 1000}k {kernel}"
        forward, backward = zip(*(each.fast.milliseconds() for each in measured), strict=True)
        rows += [timed(f"{label}: forward", forward, "ms"), timed(f"{label}: backward", backward, "ms")]
        if kernel == "ges_scale":
            continue
        plain = [each.plain.milliseconds() for each in measured]
        faster = [each.plain.total() / each.fast.total() for each in measured]
        alone = [each.one.total() / each.fast.total() for each in measured]
        rows += [
            timed(f"{label}: both", both, "ms", maximum=MARKS[size[0], kernel]),
            timed(f"{label}: plain loops, forward", [ms for ms, _ in plain], "ms"),
            timed(f"{label}: plain loops, backward", [ms for _, ms in plain], "ms"),
            timed(f"{label}: times faster than plain loops", faster, "x", minimum=SPEEDUP),
            Row(f"{label}: mean difference to plain loops", float((image - other).abs().mean()), ""),
            timed(f"{label}: times faster than with 1 thread", alone, "x"),
            Row(f"{label}: pairs of splat and pixel that get color", done.contributed / 1e6, "million"),
            Row(f"{label}: pairs evaluated", done.evaluated / 1e6, "million"),
            timed(f"{label}: roofline", [e.bound.necessary for e in measured if e.bound], "ms"),
            timed(f"{label}: fraction of the roofline", [e.fraction() for e in measured], "%", minimum=ROOFLINE),
            timed(f"{label}: fraction if all lanes counted", [e.fraction("evaluated") for e in measured], "%"),
            timed(f"{label}: fraction by exponentials and bytes only", [e.fraction("simple") for e in measured], "%"),
            timed(f"{label}: fraction of the roofline, 1 thread", [e.fraction_alone() for e in measured], "%"),
        ]
    for kernel in KERNELS[1:]:
        price = totals[kernel] / totals["gaussian"]
        rows.append(Row(f"{size[1]}x{size[0]}: price of {kernel} over gaussian", price, "x"))
    return rows


def beside_reference(threads: int) -> list[Row]:
    """The PyTorch reference on a small scene."""
    size, rows = (48, 64), []
    for kernel in ("gaussian", "exact"):
        splats, slow, fast = scene(1000, size[1], kernel), Times(), Times()
        for _ in range(3):
            run(splats, size, kernel, "reference", threads, slow)
            run(splats, size, kernel, "cpu", threads, fast)
        rows.append(Row(f"64x48 1k {kernel}: reference, both", slow.total(), "ms"))
        rows.append(Row(f"64x48 1k {kernel}: times faster than the reference", slow.total() / fast.total(), "x"))
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


def psnr(render: torch.Tensor, image: torch.Tensor) -> float:
    error = (render.detach().clamp(0.0, 1.0) - image).square().mean()
    return -10.0 * math.log10(error.item())


def fit(
    image: torch.Tensor, intrinsics_of_view: np.ndarray, kernel: str, seconds: float, antialiased: bool = False
) -> tuple[Splats, float, int]:
    """(splats, PSNR, iterations) of 3,000 splats fitted to one image in `seconds` of one core."""
    height, width = image.shape[:2]
    g = torch.Generator().manual_seed(0)
    pixels = torch.rand(3000, 2, generator=g) * torch.tensor([width, height])
    z = 2.0 + torch.rand(3000, generator=g)
    rays = (pixels - torch.from_numpy(intrinsics_of_view[2:]).float()) / torch.from_numpy(
        intrinsics_of_view[:2]
    ).float()
    colors = image[pixels[:, 1].long(), pixels[:, 0].long()]
    splats = Splats(
        means=torch.cat([rays, torch.ones(3000, 1)], dim=1) * z[:, None],
        log_scales=torch.log(3.0 * z / float(intrinsics_of_view[0]))[:, None].repeat(1, 3),
        quaternions=torch.randn(3000, 4, generator=g),
        opacity_logits=torch.full((3000,), -1.0),
        sh=spherical_harmonics.from_rgb(colors)[:, None],
        betas=torch.full((3000,), kernels.neutral_beta(kernel)),
    )
    leaves = [tensor.requires_grad_() for tensor in splats.tensors().values()]
    rates = (2e-3, 5e-3, 1e-3, 5e-2, 1e-2, 1e-2)
    adam = torch.optim.Adam([{"params": [leaf], "lr": rate} for leaf, rate in zip(leaves, rates)], eps=1e-15)
    start, iterations, render = time.process_time(), 0, None
    while time.process_time() - start < seconds or render is None:
        render = rasterize(
            splats, np.eye(4), intrinsics_of_view, (height, width), kernel=kernel, threads=1, antialiased=antialiased
        )
        adam.zero_grad()
        ssim.image_loss(render.color, image, l1_weight=0.8, ssim_weight=0.2, threads=1).backward()
        adam.step()
        iterations += 1
    return splats, psnr(render.color, image), iterations


def room() -> tuple[torch.Tensor, np.ndarray]:
    """One view of the synthetic room, 320x240, and its camera."""
    item = next(iter(open_dataset("synthetic", size=(240, 320))))
    return torch.from_numpy(item.image.copy()).float() / 255.0, item.intrinsics


def worth(seconds: float) -> list[Row]:
    """What each kernel reaches in the same time: one view of the synthetic room, one core."""
    rows = []
    image, intrinsics_of_room = room()
    for kernel in kernels.KERNELS:
        _, reached, iterations = fit(image, intrinsics_of_room, kernel, seconds)
        rows.append(Row(f"one view, {seconds:g} s of one core, {kernel}: PSNR", reached, "dB"))
        rows.append(Row(f"one view, {seconds:g} s of one core, {kernel}: iterations", float(iterations), ""))
    return rows


def antialiasing(threads: int, rounds: int, seconds: float) -> list[Row]:
    """What `antialiased` costs, and what it is worth to a map that is seen from farther away than it was made."""
    size, splats = (240, 320), scene(20_000, 320, "gaussian")
    times = {mode: Times() for mode in (False, True)}
    for _ in range(rounds):
        for mode, spent in times.items():
            run(splats, size, "gaussian", "cpu", threads, spent, mode)
    rows = [Row("320x240 20k gaussian: price of antialiased", times[True].total() / times[False].total(), "x")]
    image, near = room()
    small = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), 4).permute(1, 2, 0)
    far = camera.scale_intrinsics(near, size, (60, 80))
    for mode in (False, True):
        fitted, reached, _ = fit(image, near, "gaussian", seconds, mode)
        render = rasterize(fitted, np.eye(4), far, (60, 80), threads=1, antialiased=mode)
        name = "antialiased" if mode else "not antialiased"
        rows += [
            Row(f"one view, {seconds:g} s, {name}: PSNR", reached, "dB"),
            Row(f"one view, {seconds:g} s, {name}: PSNR at a quarter of the size", psnr(render.color, small), "dB"),
        ]
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    threads = options.threads
    rounds = 3 if options.quick else 7
    rows = compare((240, 320), 20_000, threads, rounds)
    rows += compare((480, 640), 50_000, threads, rounds)
    seconds = 2.0 if options.quick else 8.0
    rows += beside_reference(threads) + similarity() + worth(seconds)
    return rows + antialiasing(threads, rounds * PASSES, seconds)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, default=2, help="of the kernel, the plain loops and the peaks")


if __name__ == "__main__":
    main(measure, "rasterizer", arguments)
