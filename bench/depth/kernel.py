"""The cost kernel against plain loops: the same mathematics and arrays, compiled here with -O3 for this processor."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.table import Row, at_most, skipped
from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.interface import MatchingImages
from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.warp import relative_warp

SOURCE = Path(__file__).with_name("plain_cost_volume.cpp")
VIEWS = 4


def kernel_rows(quick: bool) -> list[Row]:
    """Processor time of one sweep, ours over the plain loops'; sizes of the default's two stages."""
    compiler = shutil.which(os.environ.get("CXX", "c++")) or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return [skipped("cost kernel", "no C++ compiler")]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "plain.so"
        flags = ["-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-shared", "-fPIC"]
        subprocess.run([compiler, *flags, str(SOURCE), "-o", str(library)], check=True)
        plain = ctypes.CDLL(str(library)).plain_cost_volume
        for (height, width), hypotheses in (((120, 160), 16 if quick else 64), ((240, 320), 11))[: 1 if quick else 2]:
            rows += _compare(plain, height, width, hypotheses)
    return rows


def _compare(plain: Callable[..., object], height: int, width: int, hypotheses: int) -> list[Row]:
    rng = np.random.default_rng(0)
    images = (60.0 * rng.standard_normal((VIEWS + 1, height, width))).astype(np.float32)
    intrinsics = np.array([width, width, (width - 1) / 2, (height - 1) / 2], dtype=np.float64)
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(1, VIEWS + 1)
    warps = np.stack([relative_warp(intrinsics, np.eye(4), intrinsics, pose) for pose in poses]).astype(np.float32)
    first, step = np.full((height, width), 0.1, np.float32), np.full((height, width), 0.01, np.float32)
    pair, radius, config = MatchingImages(images[0], images[1:], warps), 2, CostConfig()
    theirs = np.empty((height, hypotheses, width), np.float32)
    backend = NativeBackend()

    def ours() -> np.ndarray:
        return backend.cost_volume(pair, first, step, hypotheses, radius, config)

    def loops() -> None:
        floats = [a.ctypes.data_as(ctypes.c_void_p) for a in (images[0], images[1:], warps, first, step, theirs)]
        plain(
            floats[0], height, width, floats[1], floats[2], VIEWS, floats[3], floats[4], hypotheses, radius,
            config.top_k, ctypes.c_float(config.noise), ctypes.c_float(config.contrast), floats[5],
        )  # fmt: skip

    loops()
    difference = float(np.mean(np.abs(ours() - theirs)))
    seconds = [min(_processor_seconds(run) for _ in range(3)) for run in (ours, loops)]
    name = f"cost kernel, {width}x{height}, {hypotheses} hypotheses"
    return [
        Row(f"{name}: processor", 1000 * seconds[0], "ms"),
        Row(f"{name}: processor of plain -O3 loops", 1000 * seconds[1], "ms"),
        at_most(f"{name}: over plain -O3 loops", seconds[0] / seconds[1], "x", 1.2),
        at_most(f"{name}: mean difference to plain loops", difference, "", 1e-3),
    ]


def _processor_seconds(run: Callable[[], object]) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start
