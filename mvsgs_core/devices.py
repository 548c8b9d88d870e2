"""Where kernels run: the C++ ones on the CPU, or their twins in PyTorch, which is imported only where one is used."""

from __future__ import annotations

import os
import re
import shutil
import sysconfig
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mvsgs_core.named_modules import is_installed

if TYPE_CHECKING:
    from torch import Tensor

_CUDA_12 = "make clean setup PIP_FLAGS='--extra-index-url https://download.pytorch.org/whl/cu126'"


def resolve_device(device: str) -> str:
    """`device` as it is, "auto" decided: "cuda" if PyTorch sees one on which maps can be rendered, else "cpu".

    A GPU that cannot be used is warned of. Raises ValueError where one is named.
    """
    if device != "auto":
        if device.startswith("cuda") and (lacking := lacks_for_gpu(device)):
            raise ValueError(f"device={device}: {lacking}; or use device=cpu")
        return device
    import torch

    if not torch.cuda.device_count():
        return "cpu"
    if lacking := lacks_for_gpu():
        warnings.warn(f"the GPU is not used: {lacking}", stacklevel=1)
        return "cpu"
    return "cuda"


def lacks_for_gpu(device: str = "cuda") -> str:
    """What PyTorch, or Triton, which renders on a GPU, lacks here, and how it is had; empty if nothing.

    Triton builds what launches its kernels with the C compiler that CC names, or gcc or clang, and Python's headers.
    """
    if refused := torch_refuses(device):
        return refused
    if not is_installed("triton"):
        return "Triton is missing: pip install triton"
    compilers = [os.environ["CC"]] if "CC" in os.environ else ["gcc", "clang"]
    if not any(map(shutil.which, compilers)):
        named = f" (CC={compilers[0]})" if "CC" in os.environ else ""
        return f"Triton finds no C compiler{named}: sudo apt install gcc"
    scheme = sysconfig.get_default_scheme().replace("posix_local", "posix_prefix")  # as Triton takes it
    if not Path(sysconfig.get_paths(scheme)["include"], "Python.h").exists():
        return "Triton finds no Python.h: sudo apt install python3-dev"
    return ""


def torch_refuses(device: str = "cuda") -> str:
    """Why this PyTorch cannot use a GPU that is there, and what helps; empty if it can, or where there is none."""
    import torch

    number, there = device.partition(":")[2] or "0", torch.cuda.device_count()
    if not number.isdigit() or int(number) >= there:
        return ""
    if not torch.cuda.is_available():  # the devices are counted by the driver, whatever its age
        cuda = f"CUDA {torch.version.cuda}"
        return f"{cuda} does not start, most often as the driver is too old for it: renew that, or: {_CUDA_12}"
    built = [int(found[1]) for name in torch.cuda.get_arch_list() if (found := re.match(r"(?:sm|compute)_(\d+)", name))]
    major, minor = torch.cuda.get_device_capability(int(number))
    if 10 * major + minor < min(built, default=0):
        least = f"{min(built) // 10}.{min(built) % 10}"
        return f"this PyTorch is built for GPUs of capability {least} and newer, and it has {major}.{minor}: {_CUDA_12}"
    return ""


def torch_device(device: str) -> str:
    """The device of PyTorch for "auto", "cpu", "torch" (PyTorch on the CPU) or a name of its own like "cuda:1".

    PyTorch's own kernels need no compiler: a GPU that is named is taken.
    """
    if device == "auto":
        return resolve_device(device)
    return "cpu" if device == "torch" else device


class TorchTwin:
    """Base of kernels in PyTorch: numpy arrays come in and go out, between them all is on `device`."""

    def __init__(self, device: str) -> None:
        self.device = torch_device(device)

    def _on(self, array: np.ndarray) -> Tensor:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(self.device)
