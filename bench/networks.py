"""Cost of each network at 512x384: parameters, multiply-adds, CPU seconds, memory (GPU: bench.gpu).

    python -m bench.networks [--quick] [--json FILE]

Random weights where none are needed to build a network: cost does not depend on them. Each network runs in a process
of its own, on one thread, so that its peak memory is its own. Multiply-adds are those of convolutions and matrix
products; sampling and activations are not counted, and a figure of zero is left out. Seconds are of the processor, of
the second run; memory is of the third: in the first PyTorch loads what it computes with.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from bench.runs import environment
from bench.table import Row, main, skipped
from mvsgs_core import weights
from mvsgs_core.droid.networks import random_net
from mvsgs_core.evaluation.lpips import Lpips
from mvsgs_core.networks.correlation import CorrelationVolume, OnTheFlyCorrelation
from mvsgs_core.networks.itermvs import IterMvs
from mvsgs_core.networks.mvsformer import MvsFormer
from mvsgs_core.networks.raft_small import RaftSmall
from mvsgs_core.networks.vfuse import FusionInput, VFuse
from nodes.runtime.status import peak_bytes, rss

Case = tuple[nn.Module, Callable[[], object]]
_MMAP_THRESHOLD = -3  # of mallopt, malloc.h
_VIEWS = 5  # a reference and its four neighbors, as the paper


def _images(count: int, h: int, w: int, device: str) -> Tensor:
    return 255 * torch.rand(count, 3, h, w, device=device)


def _cameras(h: int, w: int, device: str) -> tuple[Tensor, Tensor]:
    """cam_from_world (V, 4, 4) side by side, and camera matrices (V, 3, 3)."""
    poses = torch.eye(4, dtype=torch.float64).repeat(_VIEWS, 1, 1)
    poses[:, 0, 3] = 0.1 * torch.arange(_VIEWS)
    k = torch.tensor([[0.9 * w, 0.0, w / 2], [0.0, 0.9 * w, h / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return poses.to(device), k.repeat(_VIEWS, 1, 1).to(device)


def droid_encoders(h: int, w: int, device: str) -> Case:
    net = random_net().to(device)
    image = _images(1, h, w, device)
    return nn.ModuleList([net.fnet, net.cnet]), lambda: (net.features(image), net.context(image))


def droid_update(h: int, w: int, device: str) -> Case:
    net = random_net().to(device)
    state, corr = torch.rand(1, 128, h // 8, w // 8, device=device), torch.rand(1, 196, h // 8, w // 8, device=device)
    source = torch.zeros(1, dtype=torch.long, device=device)
    return net.update, lambda: net.update(state, state, corr, None, source)


def _correlation(kind: type[CorrelationVolume] | type[OnTheFlyCorrelation], h: int, w: int, device: str) -> Case:
    a, b = (torch.rand(1, 128, h // 8, w // 8, device=device) for _ in range(2))
    coords = torch.rand(1, h // 8, w // 8, 2, device=device) * (h // 8)
    return nn.Module(), lambda: kind(a, b)(coords)


def _stereo(net: MvsFormer | IterMvs, h: int, w: int, device: str) -> Case:
    net.to(device).eval()
    images, (poses, cameras) = _images(_VIEWS, h, w, device), _cameras(h, w, device)
    return net, lambda: net(images, poses, cameras, (1.0, 8.0))


def vfuse(h: int, w: int, device: str) -> Case:
    net = VFuse().to(device).eval()
    depths = 2 + torch.rand(_VIEWS, h, w, device=device)
    views = FusionInput(depths, torch.rand_like(depths), *_cameras(h, w, device), near=1.0, far=8.0)
    return net, lambda: net(views)


def raft(h: int, w: int, device: str) -> Case:
    net = RaftSmall().to(device).eval()
    images = _images(2, h, w, device)
    return net, lambda: net(images[:1], images[1:])


def lpips(h: int, w: int, device: str) -> Case:
    net = Lpips(weights.find("lpips_squeeze_trunk"), weights.find("lpips_squeeze_head")).to(device)
    images = _images(2, h, w, device) / 255
    return net, lambda: net(images[:1], images[1:])


CASES: dict[str, Callable[[int, int, str], Case]] = {
    "DROID encoders, an image": droid_encoders,
    "DROID update, an edge": droid_update,
    "DROID correlation volume, an edge": lambda h, w, d: _correlation(CorrelationVolume, h, w, d),
    "DROID correlation on the fly, an edge": lambda h, w, d: _correlation(OnTheFlyCorrelation, h, w, d),
    "MVSFormer (Twins), 5 views": lambda h, w, d: _stereo(MvsFormer("twins"), h, w, d),
    "MVSFormer-P (DINO), 5 views": lambda h, w, d: _stereo(MvsFormer("dino"), h, w, d),
    "V-FUSE, 5 views": vfuse,
    "IterMVS, 5 views": lambda h, w, d: _stereo(IterMvs(), h, w, d),
    "RAFT-small, a pair": raft,
    "LPIPS (SqueezeNet), a pair": lpips,
}


def _peak(work: Callable[[], object]) -> float:
    """MB of memory that it takes for a while, beyond what is taken now."""
    system = ctypes.CDLL(None)
    system.mallopt(_MMAP_THRESHOLD, 1 << 18)  # what is freed goes back at once, which takes time
    system.malloc_trim(0)
    before = rss()
    Path("/proc/self/clear_refs").write_text("5")  # the peak is from here on
    work()
    return (peak_bytes() - before) / 1e6


@torch.no_grad()
def measure_one(name: str, h: int, w: int) -> dict[str, float | str]:
    """Figures of one case, in this process."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        net, work = CASES[name](h, w, "cpu")
    except FileNotFoundError as error:
        return {"missing": str(error)}
    work()
    start = time.process_time()
    work()
    seconds = time.process_time() - start
    memory = _peak(work)
    counter = FlopCounterMode(display=False)
    with counter:
        work()
    return {
        "parameters": sum(p.numel() for p in net.parameters()) / 1e6,
        "operations": counter.get_total_flops() / 2e9,
        "seconds": seconds,
        "memory": memory,
    }


_UNITS = (
    ("parameters", "parameters", "M"),
    ("operations", "multiply-adds", "G"),
    ("seconds", "processor", "s"),
    ("memory", "peak memory beyond weights and input", "MB"),
)


def measure(options: argparse.Namespace) -> list[Row]:
    h, w = (192, 256) if options.quick else (384, 512)
    os.environ.update(environment())
    rows = [Row("image size", f"{w}x{h}")]
    for name in CASES:
        command = [sys.executable, "-m", "bench.networks", "--case", name, str(h), str(w)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        figures = json.loads(done.stdout.splitlines()[-1])
        if "missing" in figures:
            rows.append(skipped(name, figures["missing"]))
        rows += [Row(f"{name}: {what}", figures[key], unit) for key, what, unit in _UNITS if figures.get(key)]
    return rows


if __name__ == "__main__":
    if sys.argv[1:2] == ["--case"]:
        print(json.dumps(measure_one(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))))
    else:
        main(measure, "Cost of the networks")
