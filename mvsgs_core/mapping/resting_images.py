"""Images and masks that wait on disk until they are trained on again: each in a file of its own, mapped into memory.

The system holds in memory what there is room for of them, and gives it back where others need it. A file has no name
and goes with its image, however the process ends.
"""

from __future__ import annotations

import math
import tempfile

import torch
from torch import Tensor


def on_disk(image: Tensor) -> Tensor:
    """The same image (H, W, 3) uint8 or mask (H, W) bool, on the CPU, in a file of the system's temporary folder
    (TMPDIR).

    Raises OSError where the disk takes no more.
    """
    plain = image.detach().cpu().contiguous()
    with tempfile.NamedTemporaryFile(prefix="mvsgs-image-") as file:
        file.write(plain.numpy().tobytes())
        file.flush()
        mapped = torch.from_file(file.name, shared=False, size=plain.numel(), dtype=plain.dtype)
    return mapped.view(plain.shape)


def room_of(device: torch.device) -> float:
    """Bytes that images may take on a device: a quarter of a GPU's, whose memory is needed for the map; else any."""
    if device.type != "cuda":
        return math.inf
    return float(torch.cuda.get_device_properties(device).total_memory) / 4


__all__ = ["on_disk", "room_of"]
