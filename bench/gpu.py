"""Speed on a CUDA GPU: the Triton rasterizer, a whole training iteration, the loss, the networks.

    python -m bench.gpu [--quick] [--json FILE]

Without a GPU it says so and measures nothing. Scenes are those of bench.rasterizer. Times are medians between CUDA
events, after warming up (which compiles the kernels); forward and backward are timed apart, what is compared in turns.
gsplat runs beside it where it is installed, with the same splats, camera and blur.

Roofline: the longer of the traffic to memory (parameters, projected splats, pairs with their sort and sums, images;
each as often as the algorithm needs it) at the rate of a copy measured here, and the arithmetic of those pairs
of splat and pixel that get color (counted by the C++ kernel, which ends pixels at the same splat) at the rate of a
float32 matrix product without tensor cores measured here.
"""

from __future__ import annotations

import argparse
import importlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench import networks
from bench.rasterizer import intrinsics, scene, work
from bench.table import Row, main
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.trainer import Trainer
from mvsgs_core.named_modules import is_installed
from mvsgs_core.rasterizer import ssim
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats

Action = Callable[[], object]

CASES = (((480, 640), 50_000), ((864, 1152), 1_000_000))  # (height, width), splats; the second has 1.0 megapixel
KERNELS = ("gaussian", "exact")
# floating-point operations of one splat on one pixel: forward and backward, a transcendental counted as one
OPERATIONS = {"gaussian": 24 + 56, "exact": 24 + 56 + 14}


@dataclass(frozen=True)
class Peaks:
    """Rates of this device, measured."""

    bytes: float  # a second, read and written
    operations: float  # float32 a second, a fused multiply-add counted as two


def milliseconds(actions: list[Action], device: torch.device, rounds: int, warmup: int = 3) -> list[float]:
    """Median time of each action; in every round they run one after the other."""
    taken: list[list[float]] = [[] for _ in actions]
    for i in range(warmup + rounds):
        for action, times in zip(actions, taken):
            elapsed = _elapsed(action, device)
            if i >= warmup:
                times.append(elapsed)
    return [statistics.median(times) for times in taken]


def _elapsed(action: Action, device: torch.device) -> float:
    if device.type == "cpu":
        start = time.perf_counter()
        action()
        return 1e3 * (time.perf_counter() - start)
    begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    begin.record()
    action()
    end.record()
    end.synchronize()
    return begin.elapsed_time(end)


def measure_peaks(device: torch.device, size: int, rounds: int) -> Peaks:
    """A copy of size x size x 16 floats, and a product of matrices of this size."""
    torch.backends.cuda.matmul.allow_tf32 = False
    source = torch.rand(16 * size, size, device=device)
    target = torch.empty_like(source)
    a, b = (torch.rand(size, size, device=device) for _ in range(2))
    copied, multiplied = milliseconds([lambda: target.copy_(source), lambda: a @ b], device, rounds)
    return Peaks(2 * 4 * source.numel() / (1e-3 * copied), 2.0 * size**3 / (1e-3 * multiplied))


def on_device(splats: Splats, device: torch.device) -> Splats:
    return Splats(*(tensor.detach().to(device).requires_grad_() for tensor in splats.tensors().values()))


def triton_case(splats: Splats, size: tuple[int, int], kernel: str) -> tuple[Action, Action]:
    """(forward, backward of the last forward pass)."""
    last: list[Tensor] = []
    gradient = torch.ones(*size, 3, device=splats.means.device)

    def forward() -> None:
        last[:] = [rasterize(splats, np.eye(4), intrinsics(size), size, kernel=kernel, backend="triton").color]

    return forward, lambda: last[0].backward(gradient)


def gsplat_case(splats: Splats, size: tuple[int, int]) -> tuple[Action, Action]:
    """The same for gsplat's `rasterization`, which blends Gaussians only."""
    gsplat = importlib.import_module("gsplat")

    last: list[Tensor] = []
    device = splats.means.device
    fx, fy, cx, cy = intrinsics(size).tolist()
    # its pixel centers lie at 0.5, ours at 0
    camera = torch.tensor([[[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]]], device=device)
    pose, gradient = torch.eye(4, device=device)[None], torch.ones(1, *size, 3, device=device)

    def forward() -> None:
        color, _, _ = gsplat.rasterization(
            splats.means, splats.quaternions, splats.log_scales.exp(), splats.opacity_logits.sigmoid(), splats.sh,
            pose, camera, size[1], size[0], sh_degree=0, near_plane=1e-3, packed=False,
        )  # fmt: skip
        last[:] = [color]

    return forward, lambda: last[0].backward(gradient)


def traffic(count: int, pairs: int, size: tuple[int, int]) -> float:
    """Bytes of a forward and backward pass, spherical harmonics of degree 0."""
    parameters = 4 * 15
    by_splat = 2 * parameters + parameters + 3 * 64 + 2 * 20 + 8 * 12 + 2 * 48  # read, written; rows, footprints, sort
    by_pair = 8 + 4 * 2 * 12 + 2 * 12 + 2 * 64 + 3 * 44  # listed, sorted in four passes, taken, blended, summed up
    return float(count * by_splat + pairs * by_pair + size[0] * size[1] * 4 * (5 + 10))


def rasterizer_rows(size: tuple[int, int], count: int, device: torch.device, peaks: Peaks, rounds: int) -> list[Row]:
    rows = []
    for kernel in KERNELS:
        host = scene(count, size[1], kernel)
        done = work(host, size, kernel)
        splats = on_device(host, device)
        label = f"{size[1]}x{size[0]} {count / 1000:g}k {kernel}"
        actions = [*triton_case(splats, size, kernel)]
        beside = kernel == "gaussian" and is_installed("gsplat")
        if beside:
            actions += gsplat_case(splats, size)
        taken = milliseconds(actions, device, rounds)
        ours = taken[0] + taken[1]
        memory = 1e3 * traffic(count, done.pairs, size) / peaks.bytes
        arithmetic = 1e3 * done.contributed * OPERATIONS[kernel] / peaks.operations
        rows += [
            Row(f"{label}: forward", taken[0], "ms"),
            Row(f"{label}: backward", taken[1], "ms"),
            Row(f"{label}: pairs of splats and tiles", float(done.pairs), ""),
            Row(f"{label}: fraction of the memory's bandwidth", 100.0 * memory / ours, "%"),
            Row(f"{label}: fraction of the float32 peak", 100.0 * arithmetic / ours, "%"),
            Row(f"{label}: fraction of the roofline", 100.0 * max(memory, arithmetic) / ours, "%"),
        ]
        if beside:
            rows.append(Row(f"{label}: gsplat, forward", taken[2], "ms"))
            rows.append(Row(f"{label}: gsplat, backward", taken[3], "ms"))
            rows.append(Row(f"{label}: times faster than gsplat", (taken[2] + taken[3]) / ours, "x"))
    return rows


def iteration_rows(size: tuple[int, int], count: int, device: torch.device, rounds: int) -> list[Row]:
    """The mapper's own iteration: render, L1 + SSIM, backward, Adam of what was seen; and the loss alone."""
    state = MapState(1, device)
    state.append(scene(count, size[1], "gaussian"), torch.zeros(count, dtype=torch.int64))
    g = np.random.default_rng(0)
    image = g.integers(0, 255, (*size, 3), dtype=np.uint8)
    posed = RGBDKeyframe(0, image, intrinsics(size), np.eye(4), np.zeros(size, np.float32))
    view = training_view(posed, np.eye(4), None, device)
    trainer = Trainer(MapperConfig(training=TrainingConfig(backend="triton")), state, Stats())
    rendered = torch.rand(*size, 3, device=device, requires_grad=True)
    target = view.target

    def iteration() -> None:
        trainer.step(view, 1.0, refining=True)

    def loss() -> None:
        ssim.image_loss(rendered, target, l1_weight=0.8, ssim_weight=0.2, backend="triton").backward()

    taken = milliseconds([iteration, loss], device, rounds)
    label = f"{size[1]}x{size[0]} {count / 1000:g}k"
    return [
        Row(f"{label}: training iteration with loss and Adam", taken[0], "ms"),
        Row(f"{label}: iterations a second", 1e3 / taken[0], ""),
        Row(f"{size[1]}x{size[0]}: L1 + SSIM with its gradient", taken[1], "ms"),
    ]


@torch.no_grad()
def network_rows(size: tuple[int, int], device: torch.device, rounds: int) -> list[Row]:
    """The networks of bench.networks; those of DROID-SLAM in half precision, as they run."""
    rows = []
    for name, case in networks.CASES.items():
        try:
            _, action = case(*size, device.type)
        except FileNotFoundError as error:
            rows.append(Row(f"{name}: not measured", str(error)))
            continue
        half = device.type == "cuda" and name.startswith("DROID")
        with torch.autocast(device.type, dtype=torch.float16, enabled=half):
            rows.append(Row(f"{name}, {size[1]}x{size[0]}", milliseconds([action], device, rounds)[0], "ms"))
    return rows


def measure_on(
    device: torch.device, cases: tuple[tuple[tuple[int, int], int], ...], peak_size: int, network_size: tuple[int, int],
    rounds: int,
) -> list[Row]:  # fmt: skip
    """All rows on one device."""
    peaks = measure_peaks(device, peak_size, rounds)
    rows = [
        Row("copy", peaks.bytes / 1e9, "GB/s"),
        Row("float32 matrix product, no tensor cores", peaks.operations / 1e12, "TFLOP/s"),
    ]
    for size, count in cases:
        rows += rasterizer_rows(size, count, device, peaks, rounds)
        rows += iteration_rows(size, count, device, rounds)
    return rows + network_rows(network_size, device, rounds)


def measure(options: argparse.Namespace) -> list[Row]:
    if not torch.cuda.is_available():
        print("no CUDA GPU on this machine: nothing was measured")
        return []
    rows = [Row("GPU", torch.cuda.get_device_name())]
    rounds = 5 if options.quick else 30
    return rows + measure_on(torch.device("cuda"), CASES[: 1 if options.quick else 2], 4096, (384, 512), rounds)


if __name__ == "__main__":
    main(measure, "gpu")
