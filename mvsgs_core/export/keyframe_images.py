"""The images that the keyframes of a map were trained on, as files: what a COLMAP model refers to."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.atomic_file import replacing
from mvsgs_core.datasets.files import UnreadableImageError, read_image

FOLDER = "keyframes"  # beside map.ply


def image_name(index: int) -> str:
    """Of the keyframe that is frame `index` of the stream."""
    return f"{index:06d}.png"


def there(folder: Path, keyframes: np.ndarray) -> np.ndarray:
    """(K,) bool: keyframes (K,) whose image is there. Those of a stream before have theirs in that run's output."""
    return np.array([(folder / image_name(index)).is_file() for index in keyframes.tolist()], dtype=bool)


def write_image(folder: Path, index: int, image: np.ndarray) -> None:
    """Writes an (H, W, 3) uint8 RGB image without loss. Raises OSError where it cannot be written: no part of it is
    there then."""
    folder.mkdir(parents=True, exist_ok=True)
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not encoded:
        raise OSError(f"the image of keyframe {index} cannot be encoded as PNG")
    with replacing(folder / image_name(index), sync=False) as aside:
        aside.write_bytes(data.tobytes())


def known_image(folder: Path, index: int) -> np.ndarray | None:
    """(H, W, 3) uint8 RGB of a keyframe; None where it was not kept, or cannot be read."""
    file = folder / image_name(index)
    try:
        return read_image(file) if file.is_file() else None
    except UnreadableImageError:
        return None
