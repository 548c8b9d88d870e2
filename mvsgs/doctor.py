"""`mvsgs doctor`: what this machine has for a run, and a map of the embedded room in ten seconds as proof."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import torch

from launch.named_input import quoted
from mvsgs import WORKSPACE
from mvsgs_core import machine, native, weights
from mvsgs_core.devices import lacks_for_gpu, torch_refuses
from mvsgs_core.named_modules import is_installed
from mvsgs_core.open3d_loader import open3d

KERNELS = ("rasterizer", "mapping", "tracking", "mvs", "fusion", "scene")
NEEDED = ("torch", "numpy", "pyzmq", "opencv-contrib-python-headless", "open3d", "viser", "av")
OPTIONAL = {  # module: what it is for, how it is had
    "rosbags": "bags of ROS (pip install rosbags)",
    "cyclonedds": "ROS 2 (pip install cyclonedds)",
    "triton": "rendering on a GPU (pip install triton)",
}
LEAST_PSNR = 28.0  # dB of the self-test's held-out frames, where it gives 35
TOO_LONG = 300.0  # s


def checks() -> Iterator[tuple[str, str, bool]]:
    """What is looked at, what was found, and whether runs work with it."""
    memory = psutil.virtual_memory()
    yield "version", f"{machine.version() or 'not installed'}, {WORKSPACE}", True
    yield "python", f"{platform.python_version()}, {sys.executable}", sys.version_info >= (3, 11)
    yield "system", f"{platform.system()} {platform.release()} {platform.machine()}", True
    yield "processor", *_processor()
    yield "memory", f"{memory.available / 1e9:.1f} of {memory.total / 1e9:.1f} GB free", memory.available > 2e9
    yield "disk", *_disk()
    yield from _kernels()
    yield "gpu", *_gpu()
    for name in NEEDED:
        yield name, *_needed(name)
    for module, purpose in OPTIONAL.items():
        there = is_installed(module)
        yield module, _version(module) or "there" if there else f"not there; only for {purpose}", True
    for entry in weights.REGISTRY.values():
        try:
            found = str(weights.find(entry.name))
        except FileNotFoundError:
            found = f"not there; only for {entry.network}: {weights.remedy(entry.name)}"
        yield f"weights {entry.name}", found, True


def self_test(folder: Path) -> tuple[str, bool]:
    """Maps 30 small frames of the embedded room, in processes as any run; what was reached, whether that is right."""
    output, began = folder / "out", time.monotonic()
    command = [
        sys.executable, str(WORKSPACE / "launch/run_all.py"), "dataset=synthetic", "dataset.stop=30",
        "dataset.size=[96,128]", "mapper.iterations=20", "mapper.refinement=40", "evaluator.lpips=off", "device=auto",
        f"output={quoted(str(output))}", "screen=off",
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TOO_LONG, cwd=folder)
    except subprocess.TimeoutExpired:
        return f"not done in {TOO_LONG:.0f} s", False
    seconds = time.monotonic() - began
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        return f"failed with code {done.returncode}: {said[0] if said else 'nothing was said'}", False
    report = json.loads((output / "report.json").read_text())
    psnr, tracked = report["rendering"]["held_out"]["psnr"], report["trajectory"]["frames_tracked"]
    reached = f"{tracked} of 30 frames tracked, held-out PSNR {psnr or 0.0:.1f} dB, {seconds:.0f} s"
    right = tracked == 30 and psnr is not None and psnr >= LEAST_PSNR
    return reached if right else f"{reached}: at least {LEAST_PSNR:.0f} dB of all frames were expected", right


def _needed(name: str) -> tuple[str, bool]:
    version = _version(name)
    if version is None:
        return "missing: make setup", False
    try:
        if name == "open3d":  # it needs libraries of the system's, which pip does not bring
            open3d()
    except ImportError as error:
        return f"{version}, for meshes: {error}", False
    return version, True


def _processor() -> tuple[str, bool]:
    try:
        return machine.processor(), True
    except ImportError as error:  # MVSGS_ARCH forces kernels that it cannot run
        return str(error), False


def _disk() -> tuple[str, bool]:
    try:
        folder = tempfile.gettempdir()
    except FileNotFoundError as error:  # of all that it tries
        return f"no folder takes temporary files: free some room, or set TMPDIR to a folder ({error.strerror})", False
    free = shutil.disk_usage(folder).free
    return f"{free / 1e9:.1f} GB free in {folder}", free > 1e9


def _kernels() -> Iterator[tuple[str, str, bool]]:
    loaded = {}
    for name in KERNELS:
        try:
            loaded[name] = native.load(name).__name__.rpartition("_")[2]
        except ImportError as error:
            yield "kernels", str(error), False
            return
    used = sorted(set(loaded.values()))
    best = native.instruction_sets()[0]
    slower = "" if used == [best] else f"; {best} would be faster and is not built: make setup"
    yield "kernels", f"{', '.join(loaded)}: {', '.join(used)}{slower}", True


def _gpu() -> tuple[str, bool]:
    names = machine.gpus()
    if not names and (refused := torch_refuses()):
        return f"not used: {refused}", True
    if not names:
        built = "PyTorch sees none" if torch.version.cuda else "this PyTorch is built for processors alone"
        return f"none: {built}; runs use the processor", True
    lacking = lacks_for_gpu()
    use = f"not used: {lacking}" if lacking else "device=cpu leaves it alone"
    return f"{', '.join(names)}, CUDA {torch.version.cuda}; {use}", True


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def main(arguments: list[str] | None = None, prog: str = "mvsgs doctor") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("--no-test", action="store_true", help="only look, map nothing")
    options = parser.parse_args(arguments)
    wrong = []
    for name, found, right in checks():
        wrong += [] if right else [name]
        print(f"{'' if right else '! '}{name:{30 if right else 28}} {found}", flush=True)
    if not options.no_test:
        print(f"{'self-test':30} ", end="", flush=True)
        try:
            with tempfile.TemporaryDirectory() as folder:
                reached, right = self_test(Path(folder))
        except OSError as error:
            reached, right = f"cannot be made: {error.strerror or error}", False
        wrong += [] if right else ["self-test"]
        print(reached if right else f"! {reached}")
    print(f"to be looked at: {', '.join(wrong)}" if wrong else "all is well")
    return 1 if wrong else 0
