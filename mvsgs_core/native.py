"""Loads the C++ kernels in the best instruction set that this CPU has.

Every module is built once per instruction set (CMakeLists.txt): `_rasterizer_v4` (AVX-512), `_rasterizer_v3` (AVX2),
`_rasterizer_generic`. `MVSGS_ARCH=generic|v3|v4` forces one, for tests and benchmarks.
"""

from __future__ import annotations

import functools
import importlib
import os
import platform
from pathlib import Path
from types import ModuleType

_FLAGS = {
    "v4": {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2", "f16c"},
    "v3": {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"},
    "generic": set[str](),
}


@functools.cache
def instruction_sets() -> tuple[str, ...]:
    """The instruction sets that kernels may use, the best first: all that this CPU can run, or the one that is forced.

    Raises ImportError if this CPU cannot run that one.
    """
    flags: set[str] = set()
    cpuinfo = Path("/proc/cpuinfo")
    if platform.machine() in ("x86_64", "AMD64") and cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("flags"):
                flags = set(line.split(":", 1)[1].split())
                break
    known = tuple(name for name, needed in _FLAGS.items() if needed <= flags)
    forced = os.environ.get("MVSGS_ARCH")
    if forced and forced not in known:
        raise ImportError(f"MVSGS_ARCH={forced}: this CPU has {', '.join(known)}")
    return (forced,) if forced else known


@functools.cache
def load(name: str) -> ModuleType:
    """The kernel module `name` ("rasterizer", "tracking", "mvs"), for example `load("rasterizer").forward(...)`.

    Raises ImportError, saying what to run, if the kernels were not built.
    """
    for arch in instruction_sets():
        try:
            return importlib.import_module(f"mvsgs_core._{name}_{arch}")
        except ModuleNotFoundError:
            continue
    raise ImportError(
        f"the C++ kernels `_{name}` are not built: run `make setup` (needs a C++ compiler: apt install g++)"
    )
