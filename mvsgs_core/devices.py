"""Where kernels run: the C++ ones on the CPU, or their twins in PyTorch, which is imported only where one is used."""

from __future__ import annotations

import os
import shutil
import sysconfig
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mvsgs_core.named_modules import is_installed

if TYPE_CHECKING:
    from torch import Tensor


def resolve_device(device: str) -> str:
    """`device` as it is, "auto" decided: "cuda" if PyTorch sees one on which maps can be rendered, else "cpu".

    A GPU that cannot be used is warned of. Raises ValueError where one is named.
    """
    if device != "auto":
        if device.startswith("cuda") and (lacking := lacks_for_gpu()):
            raise ValueError(f"device={device}: {lacking}; or use device=cpu")
        return device
    import torch

    if not torch.cuda.is_available():
        return "cpu"
    if lacking := lacks_for_gpu():
        warnings.warn(f"the GPU is not used: {lacking}", stacklevel=1)
        return "cpu"
    return "cuda"


def lacks_for_gpu() -> str:
    """What Triton, which renders on a GPU, lacks here, and how it is had; empty if nothing.

    It builds what launches its kernels with the C compiler that CC names, or gcc or clang, and Python's headers.
    """
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
