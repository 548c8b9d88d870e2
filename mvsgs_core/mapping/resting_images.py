"""Images and masks that wait on disk until they are trained on again: in files of many, mapped into memory.

The system holds in memory what there is room for of them, and gives it back where others need it. A file has no name
and goes with the last of its images, however the process ends.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import threading
import weakref

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.stats import Stats

SLOTS = 1024  # images of a file: Linux maps 65,530 pieces into a process, and lets it open 1,024 files


class _File:
    """Images of about the same size, each in a slot, which another one gets when nothing refers to it any more."""

    def __init__(self, size: int) -> None:
        """size: bytes of a slot, whole pages. Raises OSError."""
        self.size = size
        self.free = list(range(SLOTS))[::-1]
        self._file = tempfile.TemporaryFile(prefix="mvsgs-images-", buffering=0)  # noqa: SIM115 - as long as its images
        weakref.finalize(self, self._file.close)
        self._file.truncate(SLOTS * size)  # takes no room yet
        self._mapped = mmap.mmap(self._file.fileno(), SLOTS * size)

    def put(self, plain: np.ndarray, slot: int) -> Tensor:
        """Into a slot that was taken from `free`. Raises OSError where the disk takes no more: written through the
        mapping, that would end the process."""
        offset, rest = slot * self.size, memoryview(plain.tobytes())
        try:
            while rest:
                rest = rest[os.pwrite(self._file.fileno(), rest, offset + plain.nbytes - len(rest)) :]
        except OSError:
            self.free.append(slot)
            raise
        # who shares the memory of `array`, be it a tensor or an array of one, holds `array`, and that the file
        array = np.frombuffer(self._mapped, plain.dtype, plain.size, offset).reshape(plain.shape)
        weakref.finalize(array, self._give_back, slot).atexit = False
        return torch.from_numpy(array)

    def _give_back(self, slot: int) -> None:
        self.free.append(slot)


_files: weakref.WeakSet[_File] = weakref.WeakSet()  # of this process; they live as long as an image in them does
_TAKING = threading.Lock()  # a slot: two maps in one program have a thread each


def on_disk(image: Tensor) -> Tensor:
    """The same image (H, W, 3) uint8 or mask (H, W) bool, on the CPU, in a file of the system's temporary folder
    (TMPDIR).

    Raises OSError where the disk takes no more, or the system maps no more files.
    """
    plain = np.ascontiguousarray(image.detach().cpu().numpy())
    size = -(-plain.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
    with _TAKING:
        file = next((file for file in _files if file.size == size and file.free), None)
        if file is None:
            _files.add(file := _File(size))
        slot = file.free.pop()
    return file.put(plain, slot)


def rest(view: TrainingView, log: Stats) -> bool:
    """A keyframe's image goes to disk, with its mask; False where the disk is full: it stays, which is said."""
    try:
        valid = None if view.valid is None else on_disk(view.valid)
        view.image, view.valid, view.image_on_disk = on_disk(view.image), valid, True
    except OSError as error:
        log.warn(f"images stay in memory beyond mapper.images_in_memory: {error}")
        return False
    return True


def room_of(device: torch.device) -> float:
    """Bytes that images may take on a device: a quarter of a GPU's, whose memory is needed for the map; else any."""
    if device.type != "cuda":
        return math.inf
    return float(torch.cuda.get_device_properties(device).total_memory) / 4


def bytes_of(view: TrainingView) -> int:
    """Of its image and mask."""
    return view.image.numel() + (0 if view.valid is None else view.valid.numel())


__all__ = ["bytes_of", "on_disk", "rest", "room_of"]
