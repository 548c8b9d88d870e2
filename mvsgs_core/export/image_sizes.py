"""Whether the images of keyframes are as large as their cameras say: readers of a model take both for granted."""

from __future__ import annotations

from pathlib import Path

from PIL import Image, UnidentifiedImageError

from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.keyframe_images import image_name, there


def check_size(image: Path, size: tuple[int, int]) -> None:
    """Raises ValueError for a file that is no image, or not of `size` (height, width); OSError, FileNotFoundError."""
    try:
        with Image.open(image) as opened:
            width, height = opened.size
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ValueError(f"{image} is no image that can be read: {error}") from None
    if (height, width) != size:
        raise ValueError(f"{image} has {width}x{height} pixels, its camera {size[1]}x{size[0]}")


def check_sizes(folder: Path, cameras: Cameras) -> None:
    """Of those that are there: see `check_size`."""
    here = cameras.chosen(there(folder, cameras.keyframes))
    for index, (height, width) in zip(here.keyframes.tolist(), here.sizes.tolist()):
        check_size(folder / image_name(index), (height, width))


__all__ = ["check_size", "check_sizes"]
