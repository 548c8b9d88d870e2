"""Files of a sequence: images and depth maps read strictly, natural order, and errors that say what was expected."""

from __future__ import annotations

import importlib
import io
import math
import os
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import IO, BinaryIO

import numpy as np
from PIL import Image, ImageFile, ImageOps

from mvsgs_core.bad_file import BadFileError, brief, reading

_NETPBM = (".ppm", ".pgm", ".pnm")
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", *_NETPBM, ".avif", ".heic", ".heif")
_HEIF = (".heic", ".heif")  # as phones take them
MAX_PIXELS = 2**27  # of one image: 134 million, more than cameras of 100 million have
_FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "WEBP", "PPM", "AVIF")  # of these suffixes; Pillow knows 40 more
_ORIENTATION = 0x0112  # EXIF tag
_PNG_HEADER = (b"IHDR", b"eXIf", b"iTXt", b"tEXt", b"zTXt", b"IEND")  # chunks in which Pillow finds EXIF and XMP

Image.MAX_IMAGE_PIXELS = MAX_PIXELS  # Pillow's own bound, of what it decodes inside of other formats, is the same


@dataclass(frozen=True)
class Layout:
    """What a format looks like on disk and where data in it can be had: the text of every "not found" error."""

    name: str
    files: str
    source: str

    def missing(self, what: str) -> FileNotFoundError:
        return FileNotFoundError(f"{what}; {self.name} expects: {self.files}; where to get it: {self.source}")

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


class UnreadableImageError(BadFileError):
    """A file that is missing, truncated or no image; the message names it."""


@contextmanager
def opened_image(source: Path | BinaryIO, name: str) -> Iterator[ImageFile.ImageFile]:
    """An image of which the header is read and nothing decoded yet.

    Raises UnreadableImageError, naming it `name`, for more than MAX_PIXELS pixels, and for whatever Pillow raises while
    it is open.
    """
    try:
        if isinstance(source, Path) and source.exists() and not source.is_file():
            raise UnreadableImageError(f"{name}: is no file")  # a pipe would be waited for
        formats: tuple[str, ...] = _FORMATS
        if isinstance(source, Path) and source.suffix.lower() in _HEIF:
            pi_heif = importlib.import_module("pi_heif")  # loads a library, which few need
            pi_heif.register_heif_opener()
            formats = (*_FORMATS, "HEIF")  # which Pillow does not know before
        with Image.open(source, formats=formats) as image:
            width, height = image.size
            if not 0 < width * height <= MAX_PIXELS:
                raise UnreadableImageError(f"{name}: {width}x{height} pixels, more than {MAX_PIXELS}: scale it down")
            yield image
    except UnreadableImageError:
        raise
    except Exception as error:  # damaged content makes Pillow raise nearly anything
        raise UnreadableImageError(f"{name}: {brief(error)}") from error


def read_image(
    source: Path | BinaryIO, *, name: str | None = None, turn_upright: bool = True, enough: int | None = None
) -> np.ndarray:
    """(H, W, 3) uint8 RGB. Pillow and not OpenCV, because OpenCV fills the rest of a truncated file with gray.

    name: for messages, of what is no path. turn_upright: applies the orientation of the EXIF header. enough: pixels;
    a format that can be decoded at a half, a quarter or an eighth of its size, as JPEG, is where so many are left.
    Raises UnreadableImageError.
    """
    name = name or (source.name if isinstance(source, Path) else "image")
    with opened_image(source, name) as opened:
        if enough is not None:
            factor = min(1.0, (enough / (opened.width * opened.height)) ** 0.5)
            opened.draft("RGB", (math.ceil(factor * opened.width), math.ceil(factor * opened.height)))
        image: Image.Image = opened
        if turn_upright:
            image = ImageOps.exif_transpose(opened)
        gray_16 = image.mode.startswith("I;16") or (image.mode == "I" and opened.format == "PPM")
        if image.mode in ("I", "F") and not gray_16:
            fractions = image.mode == "F"
            command = f"mkdir converted; mogrify -path converted -format png -depth 16 *{Path(name).suffix}"
            raise UnreadableImageError(
                f"{name}: its values are {'fractions' if fractions else '32-bit integers'}, of which nothing says what "
                "is white: convert all images by one scale to 8 or 16 bit"
                + (f" (where 1 is white, with ImageMagick: {command})" if fractions else "")
            )
        if gray_16:  # Pillow's own conversion would clip it at 255
            gray = (np.asarray(image) >> 8).astype(np.uint8)
            return np.repeat(gray[..., None], 3, axis=-1)
        return np.array(image.convert("RGB"))


def dark_16_bit(paths: Sequence[Path]) -> bool:
    """Whether these images have 16 bits a channel, and none a value above 4095: as where 12 bits are stored in them.

    Those that cannot be read are no matter.
    """
    deep = False
    for path in paths:
        with suppress(UnreadableImageError):
            with opened_image(path, path.name) as opened:
                if not any(";16" in str(tile.args) for tile in opened.tile):
                    return False
            if read_image(path).max() >= 16:
                return False
            deep = True
    return deep


def exif_of(image: ImageFile.ImageFile) -> Image.Exif:
    """The EXIF header of an opened image, without decoding it. In a PNG it may come after the pixels, which Pillow's
    own `getexif` decodes to find it."""
    if image.format != "PNG":
        return image.getexif()
    assert image.fp is not None
    with Image.open(_without_pixels(image.fp), formats=("PNG",)) as header:
        return Image.Image.getexif(header)  # that of all formats, which decodes nothing


def _without_pixels(file: IO[bytes]) -> BinaryIO:
    """Of a PNG file the chunks of its header, wherever they are: all others are stepped over by their lengths."""
    place, header, kind = file.tell(), io.BytesIO(), b""
    file.seek(0)
    header.write(file.read(8))  # its magic number
    while kind != b"IEND" and len(head := file.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind in _PNG_HEADER:
            header.write(head + file.read(length + 4))  # with its checksum
        else:
            file.seek(length + 4, os.SEEK_CUR)
    file.seek(place)
    header.seek(0)
    return header


def upright_size(image: ImageFile.ImageFile) -> tuple[int, int]:
    """(height, width) of an opened image as EXIF says it should be shown, without decoding it."""
    width, height = image.size
    return (width, height) if is_turned(image) else (height, width)


def is_turned(image: ImageFile.ImageFile) -> bool:
    """Whether EXIF says that an opened image should be shown with a quarter turn, without decoding it."""
    return exif_of(image).get(_ORIENTATION, 1) in (5, 6, 7, 8)


def read_depth(path: Path, per_unit: float, invalid: tuple[int, ...] = (0,)) -> np.ndarray:
    """(H, W) float32 depth of an integer image where `per_unit` counts are one unit; `invalid` counts become 0.

    Raises UnreadableImageError, for counts of 8 bits and for fractions too, which count by another unit.
    """
    with opened_image(path, path.name) as opened:
        counts = np.asarray(_unstretched(opened))
    if counts.ndim != 2:
        raise UnreadableImageError(f"{path.name}: a depth map has one channel, this one is {counts.shape}")
    if counts.dtype.kind not in "iu" or counts.dtype.itemsize < 2:
        found = "fractions" if counts.dtype.kind == "f" else "8 bits"
        raise UnreadableImageError(
            f"{path.name}: a depth map has counts of 16 bits, {per_unit:g} of them a unit of the poses, and this one "
            f"has {found}: convert all to such counts"
        )
    depth = (counts / per_unit).astype(np.float32)
    depth[np.isin(counts, invalid) | ~(depth > 0) | np.isinf(depth)] = 0.0
    return depth


def _unstretched(image: ImageFile.ImageFile) -> Image.Image:
    """An opened image of integers with the values that are in its file. Pillow makes the maximum that a .pgm names
    65535, unless it is told that this is the maximum."""
    if image.mode == "I":
        image.tile = [
            tile._replace(args=("I", 65535)) if tile.codec_name.startswith("ppm") else tile for tile in image.tile
        ]
    return image


def read_array(path: Path) -> np.ndarray:
    """(H, W) float32 that NumPy saved, without pickle. Raises UnreadableImageError."""
    if not path.is_file():  # a pipe would be waited for
        raise UnreadableImageError(f"{path.name}: is no file")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # which a header of more than the file holds fails
    except Exception as error:  # damaged content makes NumPy raise nearly anything
        raise UnreadableImageError(f"{path.name}: {brief(error)}") from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "fiu":
        raise UnreadableImageError(f"{path.name}: a depth map is an array of rows and columns of numbers")
    if not 0 < array.size <= MAX_PIXELS:
        raise UnreadableImageError(f"{path.name}: {array.size} pixels, where {MAX_PIXELS} are the most")
    return array.astype(np.float32)


def read_numbers(path: Path) -> np.ndarray:
    """(N,) float64: the numbers of a text file, separated by white space; NaN and infinity are for the caller to judge.

    Raises BadFileError for anything else, OSError for a file that cannot be read.
    """
    with reading(path, "must hold numbers and nothing else"):
        return np.array([float(v) for v in path.read_text(encoding="utf-8-sig").split()])


def read_rows(path: Path, counts: Sequence[int], what: str) -> np.ndarray:
    """(N, one of `counts`) float64: the numbers of each line of a text file that is not empty, as in `read_numbers`.

    Raises BadFileError, which says `what` they are, for a line of more or fewer.
    """
    with reading(path, "must hold numbers and nothing else"):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = {number: [float(v) for v in line.split()] for number, line in enumerate(lines, start=1) if line.strip()}
    first = len(next(iter(rows.values()), ()))
    count = first if first in counts else counts[0]
    for number, row in rows.items():
        if len(row) != count:
            raise BadFileError(f"{path}: a line must be {count} numbers, {what}; line {number} has {len(row)}")
    return np.array(list(rows.values()), dtype=np.float64).reshape(-1, count)


def visible(folder: Path, pattern: str) -> list[Path]:
    """What a pattern finds in a folder, in the order of names, without hidden files: on other disks macOS puts `._NAME`
    beside each NAME."""
    return sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))


def inside(folder: Path, name: str, listing: Path) -> Path:
    """`folder / name` of a name that `listing` gives.

    Raises BadFileError where that leads out of the folder, by its parents, from the root or over a link: a data set
    that came from elsewhere reads its own files and no others.
    """
    with reading(listing, f"names {brief(ValueError(name))!r}"):
        path = folder / name
        path.exists()  # raises for what can be no name of a file
        if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
            raise ValueError("that is outside of its folder; copy the file into it and name it from there")
        return path


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """Sort key that puts frame2 before frame10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]


def images_in(folder: Path) -> list[Path]:
    """Image files directly in `folder`, in natural order, without masks and depth maps beside them; those that are all
    named by a time, as 1700000000.5.jpg, in the order of these."""
    images = [p for p in folder.iterdir() if is_image(p)]
    if all(re.fullmatch(r"\d+\.\d+", p.stem, re.ASCII) for p in images):
        return sorted(images, key=lambda p: (Decimal(p.stem), p.name))
    return sorted(images, key=lambda p: natural_order(p.name))


def is_image(path: Path) -> bool:
    """Whether that is a picture of its own: no hidden file, as macOS puts beside, and no mask or depth of another."""
    named = path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")
    return named and not _is_mask_beside(path) and not _is_depth_beside(path)


def numbered_images(folder: Path) -> list[Path]:
    """0.png, 1.png, ... of a folder, which may be none; any number of leading zeros."""
    return [p for p in images_in(folder) if p.stem.isascii() and p.stem.isdecimal()] if folder.is_dir() else []


def _is_mask_beside(path: Path) -> bool:
    """Whether that is the mask of an image in the same folder: NAME.jpg.png of NAME.jpg."""
    image = path.with_suffix("")
    return path.suffix.lower() == ".png" and image.suffix.lower() in IMAGE_SUFFIXES and image.exists()


def _is_depth_beside(path: Path) -> bool:
    """Whether that is depth or normals of an image in the same folder: r_0_depth_0001.png of r_0.png, as of NeRF."""
    found = re.fullmatch(r"(.+)_(depth|normal)(_\d+)?", path.stem)
    return found is not None and path.with_name(found[1] + path.suffix).exists()
