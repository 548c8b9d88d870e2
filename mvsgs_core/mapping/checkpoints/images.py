"""The keyframes' images of a checkpoint: lossless PNGs that are written once, named after what is in them.

An image never changes, so that a checkpoint only adds those of new keyframes. The name ends in the pixels' CRC-32: it
says at once whether an image is written already, and a damaged or foreign one is noticed.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from mvsgs_core.atomic_file import replacing
from mvsgs_core.mapping.keyframes import TrainingView

QUICK = [  # half the time that the encoder's own choice takes, for photographs of about the same size
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB,
]  # fmt: skip
NAME = re.compile(r"-?\d{1,19}-[0-9a-f]{8}\.png", re.ASCII)  # frame index, checksum


def image_name(view: TrainingView) -> str:
    """File name of a keyframe's image; empty where it was let go."""
    return f"{view.index:06d}-{_checksum(pixels_of(view)):08x}.png" if view.has_image else ""


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
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name of a keyframe's image")
    try:
        data = np.fromfile(folder / name, dtype=np.uint8)
        found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if _plausible(data) else None
    except (OSError, cv2.error) as error:
        raise ValueError(f"{folder / name} cannot be read: {error}") from error
    if found is None or found.dtype != np.uint8 or found.ndim != 3:
        raise ValueError(f"{folder / name} is damaged: no image of a keyframe")
    pixels = cv2.cvtColor(found, cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    if f"{_checksum(pixels):08x}" != name[-12:-4]:
        raise ValueError(f"{folder / name} is damaged: it shows something else than its name says")
    return image_of(pixels)


def image_of(pixels: np.ndarray) -> tuple[Tensor, Tensor | None]:
    """The image (H, W, 3) and its valid pixels (H, W) bool, None where all are, of what `pixels_of` gave."""
    image = torch.from_numpy(np.array(pixels[..., :3], order="C"))
    return image, torch.from_numpy(pixels[..., 3] > 0) if pixels.shape[2] == 4 else None


def pixels_of(view: TrainingView) -> np.ndarray:
    """(H, W, 3), or with the valid pixels as alpha (H, W, 4), uint8."""
    image = np.ascontiguousarray(view.image.cpu().numpy())
    return image if view.valid is None else np.dstack([image, view.valid.cpu().numpy().astype(np.uint8) * 255])


def _plausible(data: np.ndarray) -> bool:
    """Whether the header claims no more pixels than deflate can have made of so few bytes: 1,032 of one."""
    width, height = np.frombuffer(data[16:24].tobytes().ljust(8, b"\0"), dtype=">u4").tolist()
    return 0 < width * height <= 1032 * len(data)


def _checksum(pixels: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(pixels).data, zlib.crc32(repr(pixels.shape).encode()))
