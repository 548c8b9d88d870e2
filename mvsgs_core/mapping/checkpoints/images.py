"""The keyframes' images of a checkpoint: lossless PNGs that are written once, named after what is in them.

An image never changes, so that a checkpoint only adds those of new keyframes. The name ends in the pixels' CRC-32: it
says at once whether an image is written already, and a damaged or foreign one is noticed.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from mvsgs_core.atomic_file import replacing
from mvsgs_core.mapping.checkpoints.pixels import checksum, read_pixels
from mvsgs_core.mapping.keyframes import TrainingView

QUICK = [  # half the time that the encoder's own choice takes, for photographs of about the same size
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB,
]  # fmt: skip


def image_name(view: TrainingView) -> str:
    """File name of a keyframe's image; empty where it was let go."""
    return f"{view.index:06d}-{checksum(pixels_of(view)):08x}.png" if view.has_image else ""


def write_image(folder: Path, view: TrainingView, name: str, *, sync: bool) -> None:
    """A keyframe's image, if it is not there yet. Raises OSError."""
    if (folder / name).exists():
        return
    pixels = pixels_of(view)
    channels = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    whole, data = cv2.imencode(".png", cv2.cvtColor(pixels, channels), QUICK)
    if not whole:
        raise OSError(f"{name} cannot be encoded as PNG")
    with replacing(folder / name, sync=sync) as aside:
        aside.write_bytes(data.tobytes())


def read_image(folder: Path, name: str) -> tuple[Tensor, Tensor | None]:
    """A keyframe's image (H, W, 3) uint8 and its valid pixels (H, W) bool, None where all are; no name: empty.

    Raises ValueError for an image that is missing, damaged or another than its name says.
    """
    if not name:
        return torch.zeros((0, 0, 3), dtype=torch.uint8), None
    return image_of(read_pixels(folder, name))


def image_of(pixels: np.ndarray) -> tuple[Tensor, Tensor | None]:
    """The image (H, W, 3) and its valid pixels (H, W) bool, None where all are, of what `pixels_of` gave."""
    image = torch.from_numpy(np.array(pixels[..., :3], order="C"))
    return image, torch.from_numpy(pixels[..., 3] > 0) if pixels.shape[2] == 4 else None


def pixels_of(view: TrainingView) -> np.ndarray:
    """(H, W, 3), or with the valid pixels as alpha (H, W, 4), uint8."""
    image = np.ascontiguousarray(view.image.cpu().numpy())
    return image if view.valid is None else np.dstack([image, view.valid.cpu().numpy().astype(np.uint8) * 255])
