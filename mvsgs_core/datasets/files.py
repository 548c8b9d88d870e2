"""Files of a sequence: images and depth maps read strictly, natural order, and errors that say what was expected."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm")
_ORIENTATION = 0x0112  # EXIF tag


@dataclass(frozen=True)
class Layout:
    """What a format looks like on disk and where data in it can be had: the text of every "not found" error."""

    name: str
    files: str
    source: str

    def missing(self, what: str) -> FileNotFoundError:
        return FileNotFoundError(f"{what}\n{self.name} expects: {self.files}\nWhere to get it: {self.source}")

    def present(self, path: str | Path | None) -> Path:
        """`path` as a folder or file that is there. Raises FileNotFoundError saying where the data can be had."""
        if path is None or not str(path):
            raise self.missing("no path was given (set dataset.path)")
        found = Path(path).expanduser()
        if not found.exists():
            raise self.missing(f"{found} is missing")
        return found

    def folder(self, path: str | Path | None) -> Path:
        """`path` as an existing folder. Raises FileNotFoundError saying the layout and where the data can be had."""
        folder = self.present(path)
        if not folder.is_dir():
            raise self.missing(f"{folder} is not a folder")
        return folder

    def file(self, path: Path) -> Path:
        if not path.is_file():
            raise self.missing(f"{path} is missing")
        return path


class UnreadableImageError(Exception):
    """A file that is missing, truncated or no image; the message names it."""


def read_image(path: Path, *, turn_upright: bool = True) -> np.ndarray:
    """(H, W, 3) uint8 RGB. Pillow and not OpenCV, because OpenCV fills the rest of a truncated file with gray.

    turn_upright: applies the orientation of the EXIF header. Raises UnreadableImageError.
    """
    try:
        with Image.open(path) as opened:
            image: Image.Image = opened
            if turn_upright:
                image = ImageOps.exif_transpose(opened)
            if image.mode.startswith("I;16"):  # 16-bit gray: Pillow's own conversion would clip it at 255
                gray = (np.asarray(image) >> 8).astype(np.uint8)
                return np.repeat(gray[..., None], 3, axis=-1)
            return np.array(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise UnreadableImageError(f"{path.name}: {error}") from error


def upright_size(image: Image.Image) -> tuple[int, int]:
    """(height, width) of an opened image as EXIF says it should be shown, without decoding it."""
    width, height = image.size
    turned = image.getexif().get(_ORIENTATION, 1) in (5, 6, 7, 8)  # a quarter turn
    return (width, height) if turned else (height, width)


def read_depth(path: Path, per_unit: float, invalid: tuple[int, ...] = (0,)) -> np.ndarray:
    """(H, W) float32 depth of an integer image where `per_unit` counts are one unit; `invalid` counts become 0.

    Raises UnreadableImageError.
    """
    try:
        with Image.open(path) as opened:
            counts = np.asarray(opened)
    except (OSError, SyntaxError, ValueError) as error:
        raise UnreadableImageError(f"{path.name}: {error}") from error
    if counts.ndim != 2:
        raise UnreadableImageError(f"{path.name}: a depth map has one channel, this one is {counts.shape}")
    depth = (counts / per_unit).astype(np.float32)
    depth[np.isin(counts, invalid)] = 0.0
    return depth


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """Sort key that puts frame2 before frame10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part]


def images_in(folder: Path) -> list[Path]:
    """Image files directly in `folder`, in natural order."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(found, key=lambda p: natural_order(p.name))
