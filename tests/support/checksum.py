"""Checksums of the maps of two small runs: a change that should change no figure is held against them.

A sum holds for one kind of machine and one set of libraries. `python -m tests.support.checksum` adds this machine's,
from the code as it stands: run it before such a change, or after one that is meant to change the map, and commit it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch

from mvsgs_core import native
from tests.support.shared_data import ROOT

RECORDED = ROOT / "tests" / "checksums.json"
SMALL = (
    "dataset=synthetic", "dataset.size=[120,160]", "dataset.options.frames=60", "mapper.iterations=10",
    "mapper.refinement=30",
)  # fmt: skip
RUNS = {
    "default": SMALL,
    "every option": (
        *SMALL, "mapper.training.kernel=exact", "mapper.training.betas=true", "mapper.training.loss=ges",
        "mapper.training.refine_poses=true", "mapper.sh_degree=2",
    ),
}  # fmt: skip
ONE_THREAD = tuple(f"{slot}.threads=1" for slot in ("tracker", "mvs", "depth_fusion", "mapper"))
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def machine() -> str:
    """What a sum depends on besides our code: processor, compiler and libraries."""
    cpu: dict[str, str] = {}
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        name, _, value = line.partition(":")
        cpu.setdefault(name.strip(), value.strip())
    compiler = subprocess.run([os.environ.get("CXX", "c++"), "-dumpfullversion"], capture_output=True, text=True).stdout
    parts = [
        *(cpu.get(name, "?") for name in ("vendor_id", "cpu family", "model")), native.instruction_sets()[0],
        f"c++ {compiler.strip()}", "-".join(platform.libc_ver()),
        *(f"{module.__name__} {module.__version__}" for module in (torch, np, cv2)),
    ]  # fmt: skip
    return ", ".join(parts)


def checksum(run: str, folder: Path) -> str:
    """SHA-256 of map.ply after a run in one process with one thread. Raises CalledProcessError where it fails."""
    command = [
        sys.executable, str(ROOT / "launch/run_all.py"), "--inline", f"output={folder}", "device=cpu",
        "evaluator.max_frames=0", "screen=off", *ONE_THREAD, *RUNS[run],
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, **THREADS}, cwd=ROOT)
    return hashlib.sha256((folder / "map.ply").read_bytes()).hexdigest()


def main() -> None:
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        recorded[machine()] = {run: checksum(run, Path(folder) / run.replace(" ", "-")) for run in RUNS}
    RECORDED.write_text(json.dumps(recorded, indent=2, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
