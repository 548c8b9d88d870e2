"""The pixels of a checkpoint's images, as their files have them; no torch here, see `files`."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np

NAME = re.compile(r"-?\d{1,19}-[0-9a-f]{8}\.png", re.ASCII)  # frame index, checksum


def read_pixels(folder: Path, name: str) -> np.ndarray:
    """(H, W, 3), or with the valid pixels as alpha (H, W, 4), uint8.

    Raises ValueError for an image that is missing, damaged or another than its name says.
    """
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
    if f"{checksum(pixels):08x}" != name[-12:-4]:
        raise ValueError(f"{folder / name} is damaged: it shows something else than its name says")
    return pixels


def checksum(pixels: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(pixels).data, zlib.crc32(repr(pixels.shape).encode()))


def _plausible(data: np.ndarray) -> bool:
    """Whether the header claims no more pixels than deflate can have made of so few bytes: 1,032 of one."""
    width, height = np.frombuffer(data[16:24].tobytes().ljust(8, b"\0"), dtype=">u4").tolist()
    return 0 < width * height <= 1032 * len(data)


__all__ = ["NAME", "checksum", "read_pixels"]
