"""What a result was computed on and by: the machine in words, and the version of this program."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

from mvsgs_core import native

_ROOT = Path(__file__).resolve().parents[1]
_GIT_SECONDS = 5.0  # for git to answer
KERNELS = {"v4": "AVX-512", "v3": "AVX2", "generic": "generic kernels"}


def available_cores(root: Path = Path("/")) -> int:
    """Cores that this process may use: its affinity, limited by the quota of a container or a service.

    root: of the file system that says so.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min([cores, *(max(1, math.ceil(limit)) for limit in _quotas(root))])


def _quotas(root: Path) -> Iterator[float]:
    """Cores that each control group allows which this process is in, by its own limit or one above it."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        top = root / "sys/fs/cgroup" / ("cpu" if controllers else "")
        own = top / path.strip("/")
        for group in (own, *own.parents):  # in a container that sees its host's path, only the top is there
            with suppress(OSError, ValueError):
                yield _quota_v1(group) if controllers else _quota(group)
            if group == top:
                break


def _quota(group: Path) -> float:
    """Raises OSError or ValueError where there is none."""
    limit, period = (group / "cpu.max").read_text().split()
    return int(limit) / int(period)  # no number: "max"


def _quota_v1(group: Path) -> float:
    """Raises OSError or ValueError where there is none."""
    limit = int((group / "cpu.cfs_quota_us").read_text())
    if limit < 0:
        raise ValueError("no limit")
    return limit / int((group / "cpu.cfs_period_us").read_text())


def processor() -> str:
    """In one line: its name, the cores that this process may use, the instructions that the kernels use."""
    return f"{_model()}, {available_cores()} cores, {KERNELS[native.instruction_sets()[0]]}"


def gpus() -> list[str]:
    """Names of the CUDA devices that PyTorch sees."""
    import torch  # takes a second to load, and most who ask have it

    return (
        [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    )


def described() -> dict[str, str]:
    """The machine, by what there is to say of it."""
    import torch

    return {
        "processor": processor(),
        "memory": f"{psutil.virtual_memory().total / 1e9:.1f} GB",
        "GPU": ", ".join(gpus()) or "none",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "Python, PyTorch": f"{platform.python_version()}, {torch.__version__}",
    }


def version() -> str | None:
    """Of the installed package, with the commit of a checkout; None where neither is known."""
    try:
        number = importlib.metadata.version("mvsgs")
    except importlib.metadata.PackageNotFoundError:
        number = ""
    return " ".join(filter(None, (number, _commit()))) or None


def _model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or "unknown CPU"


def _commit() -> str:
    """Of the checkout that runs, with a plus where its files differ from it; empty where it is none."""
    if not (_ROOT / ".git").exists():
        return ""
    git = ["git", "-C", str(_ROOT)]
    try:
        name = subprocess.run(
            [*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, timeout=_GIT_SECONDS
        )
        changed = subprocess.run([*git, "diff", "--quiet", "HEAD"], capture_output=True, timeout=_GIT_SECONDS)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return f"({name.stdout.strip()}{'+' if changed.returncode else ''})" if name.returncode == 0 else ""


__all__ = ["KERNELS", "described", "gpus", "processor", "version"]
