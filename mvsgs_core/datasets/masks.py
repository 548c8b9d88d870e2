"""Masks: which pixels of an image count. 0 is to be ignored and all else counts, as for COLMAP and nerfstudio.

People, cars, the robot's own body, a watermark, a fisheye's rim. A mask belongs to one image, or to all of a camera; an
image that was cut out has its own, where it is transparent; one that is transparent everywhere has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import ImageOps

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.files import IMAGE_SUFFIXES, UnreadableImageError, opened_image
from mvsgs_core.datasets.framing import Framing, same_shape
from mvsgs_core.datasets.lens import Lens

FOLDERS = ("masks", "mask")
_NO_ALPHA = (".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".pnm")
_LOSSY = (".jpg", ".jpeg", ".webp", ".avif", ".heic", ".heif")  # whose black is nearly black


def read_mask(path: Path, *, turn_upright: bool = True) -> np.ndarray:
    """(H, W) bool, True where a pixel counts. turn_upright: as its image is read. Raises UnreadableImageError."""
    with opened_image(path, path.name) as opened:
        image = ImageOps.exif_transpose(opened) if turn_upright else opened
        if path.suffix.lower() in _LOSSY:
            return np.asarray(image.convert("L")) >= 128
        one = image.mode in ("1", "L", "F") or image.mode.startswith("I")
        values = np.asarray(image if one else image.convert("RGB"))  # gray would be 0 where a color is dark
    return np.asarray(values > 0 if one else values.any(axis=-1))


def read_alpha(path: Path, *, turn_upright: bool = True) -> np.ndarray | None:
    """(H, W) bool of an image that was cut out: False where it is transparent; None where it has no transparency.

    Raises UnreadableImageError.
    """
    if path.suffix.lower() in _NO_ALPHA:
        return None
    with opened_image(path, path.name) as opened:
        if not opened.has_transparency_data:
            return None
        image = ImageOps.exif_transpose(opened) if turn_upright else opened
        return np.asarray(image.convert("RGBA").getchannel("A")) > 0


def masks_of(images: Sequence[Path], folder: Path, given: Path | None = None) -> list[Path | None]:
    """The mask's file of each image below `folder`, None where there is none.

    given: the folder of masks; None: masks/ in the images' folder or beside it, or in `folder`. There: NAME.jpg.png or
    NAME.png, in the subfolder that the image is in. Or NAME.jpg.png beside NAME.jpg.
    Raises ValueError where there is such a folder, and nothing in it is an image's mask.
    """
    base = images[0].parent
    places = [given] if given is not None else [at / name for at in (base, base.parent, folder) for name in FOLDERS]
    for place in dict.fromkeys(place for place in places if place.is_dir()):
        found = _in(place, images, folder)
        if any(found):
            return found
        expected = f"{images[0].name}.png or {images[0].stem}.png"
        raise ValueError(
            f"{place} has no mask of any image: that of {images[0].name} would be {expected}; a folder that is meant "
            "otherwise needs another name"
        )
    beside = [image.with_name(image.name + ".png") for image in images]
    return [path if path.is_file() else None for path in beside]


def _in(place: Path, images: Sequence[Path], folder: Path) -> list[Path | None]:
    there = {p.relative_to(place).as_posix(): p for p in place.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES}
    return [next((there[name] for name in _names(image, folder) if name in there), None) for image in images]


def _names(image: Path, folder: Path) -> list[str]:
    """What an image's mask may be called, by the longest end of its path first."""
    parts = image.relative_to(folder).parts
    ends = ["/".join(parts[i:]) for i in range(len(parts))]
    return [name for end in ends for name in (end + ".png", end.removesuffix(image.suffix) + ".png", end)]


class CameraMask:
    """One mask for all frames of a camera."""

    def __init__(self, path: str | Path, size: tuple[int, int] | None = None) -> None:
        """size: (height, width) of the camera's images, where it is known.

        Raises FileNotFoundError, and ValueError for a mask that is none: unreadable, of another shape, or all black.
        """
        self._path = Path(path).expanduser()
        if not self._path.is_file():
            raise FileNotFoundError(f"dataset.mask: {self._path} is missing: an image whose black pixels are ignored")
        try:
            self._mask = read_mask(self._path)
        except UnreadableImageError as error:
            raise BadFileError(f"dataset.mask: {error}") from error
        if not self._mask.any():
            raise ValueError(f"dataset.mask: {self._path} is all black: black is ignored, so nothing would be left")
        self._framed: dict[tuple[Lens, tuple[int, int]], np.ndarray] = {}
        if size is not None:
            self.check(size)

    @property
    def notices(self) -> list[str]:
        """What to say of it."""
        if not self._mask.all():
            return []
        return [f"dataset.mask: {self._path.name} has no black pixel, so nothing is ignored"]

    def check(self, size: tuple[int, int]) -> None:
        """Raises ValueError for images (height, width) of another shape."""
        height, width = self._mask.shape
        if not same_shape((height, width), size):
            raise ValueError(
                f"dataset.mask: {self._path} is {width}x{height}, and images are {size[1]}x{size[0]}: a mask has its "
                "image's size, or a scaled one"
            )

    def framed(self, framing: Framing, lens: Lens, size: tuple[int, int]) -> np.ndarray:
        """(h, w) bool as the lens's image becomes `size`. Raises ValueError where the images have another shape, or
        nothing is left of it."""
        key = (lens, size)
        if key not in self._framed:
            self.check(lens.size)
            found = framing.mask(self._mask, lens, size)
            if not found.any():
                raise ValueError(f"dataset.mask: {self._path} leaves nothing of the undistorted image")
            self._framed = {key: found}  # a sequence has one camera
        return self._framed[key]


__all__ = ["FOLDERS", "CameraMask", "masks_of", "read_alpha", "read_mask"]
