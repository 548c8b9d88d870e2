"""Where kernels run: the C++ ones on the CPU, or their twins in PyTorch, which is imported only where one is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor


def resolve_device(device: str) -> str:
    """`device` as it is, "auto" decided: "cuda" if PyTorch sees one, else "cpu"."""
    if device != "auto":
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def torch_device(device: str) -> str:
    """The device of PyTorch for "auto", "cpu", "torch" (PyTorch on the CPU) or a name of its own like "cuda:1"."""
    return "cpu" if device == "torch" else resolve_device(device)


class TorchTwin:
    """Base of kernels in PyTorch: numpy arrays come in and go out, between them all is on `device`."""

    def __init__(self, device: str) -> None:
        self.device = torch_device(device)

    def _on(self, array: np.ndarray) -> Tensor:
        import torch

        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(self.device)
