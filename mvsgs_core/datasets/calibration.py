"""Calibration as a user gives it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.exif import exif_doubt, read_exif_lens
from mvsgs_core.datasets.files import UnreadableImageError, opened_image, upright_size
from mvsgs_core.datasets.lens import Lens, guess_lens

FISHEYE = "fisheye"  # first of the distortion: what follows are the four coefficients of OpenCV's fisheye model
_NEAR = 0.1  # of half of a side, from the middle: there the principal point is of nearly all cameras
_SAME = 0.03  # of a side, by which the middle of images of a size is off
_SEEN = 0.9  # of half of a side, from the middle: there it is of all pictures that were not cropped
_USUAL = (  # width, height of images: principal points in the middle of another one than ours are of that
    (320, 240), (640, 360), (640, 480), (752, 480), (800, 600), (848, 480), (960, 540), (1024, 768), (1280, 720),
    (1280, 800), (1280, 960), (1280, 1024), (1440, 1080), (1600, 1200), (1920, 1080), (1920, 1200), (1920, 1440),
    (2048, 1536), (2560, 1440), (2592, 1944), (2688, 1512), (3264, 2448), (3840, 2160), (4000, 3000), (4032, 3024),
)  # fmt: skip


def lens_from_option(
    intrinsics: Sequence[float] | str, distortion: Sequence[float | str], size: tuple[int, int]
) -> tuple[Lens, list[str]]:
    """The lens of the option `intrinsics`: [fx, fy, cx, cy] in pixels of the original image (height, width), or "auto".

    distortion: OpenCV's coefficients, "fisheye" before them where they are of that model.
    Returns the lens and warnings: "auto" is a guess and says so, also in `Lens.guessed`; numbers may look like those of
    another size. Raises ValueError for anything else.
    """
    coefficients, fisheye = _model(distortion)
    if isinstance(intrinsics, str):
        if intrinsics != "auto":
            raise ValueError(f"intrinsics is null, [fx, fy, cx, cy] or auto, got {intrinsics!r}")
        lens = replace(guess_lens(size), distortion=coefficients, fisheye=fisheye)
        return lens, [
            f"intrinsics are a guess: {lens.intrinsics[0]:.0f} pixels focal length for {size[1]}x{size[0]} (65 degrees "
            f"across the longer side), {'the given' if lens.distorted else 'no'} distortion; tracker=dense estimates "
            "the focal length, a calibration (dataset.intrinsics=[fx,fy,cx,cy]) is better"
        ]
    values = [float(v) for v in intrinsics]
    if len(values) != 4:
        raise ValueError(f"intrinsics is [fx, fy, cx, cy] in pixels of the original image, got {list(intrinsics)}")
    lens = Lens((values[0], values[1], values[2], values[3]), size, coefficients, fisheye)
    return lens, size_doubt(lens)


def check_lens_option(
    intrinsics: Sequence[float] | str, distortion: Sequence[float | str], size: Sequence[int] | None = None
) -> None:
    """Raises ValueError for what `lens_from_option` would not take, of a camera whose images did not come yet.

    size: (height, width) that it was asked for; None: twice as far as the principal point.
    """
    if size is None:
        numbers = [] if isinstance(intrinsics, str) else [float(v) for v in intrinsics]
        sides = [2.0 * v + 1.0 for v in numbers[3:1:-1]]
        told = len(sides) == 2 and all(math.isfinite(v) and v >= 1.0 for v in sides)
        size = [round(v) for v in sides] if told else (480, 640)
    lens_from_option(intrinsics, distortion, (size[0], size[1]))


def size_doubt(lens: Lens, option: str = "dataset.intrinsics=") -> list[str]:
    """What to say of intrinsics that look like those of images of another size than the lens's, or of turned ones.

    option: by which they are given.
    """
    (height, width), (fx, fy, cx, cy) = lens.size, lens.intrinsics
    off = _off_middle(lens, lens.size)
    if _off_middle(lens, (width, height)) <= _NEAR and off > 2 * _NEAR:
        turned = f" (turned: [{fy:g},{fx:g},{cy:g},{cx:g}])" if fx != fy else ""
        return [
            f"the principal point cx, cy = {cx:g}, {cy:g} is that of images of {height}x{width}, and these are "
            f"{width}x{height}: if the two were exchanged, or the camera was turned after its calibration, give "
            f"{option}[{fx:g},{fy:g},{cy:g},{cx:g}]{turned}"
        ]
    theirs = 2 * cx + 1, 2 * cy + 1
    such = f" (about {theirs[0]:.0f}x{theirs[1]:.0f})" if min(cx, cy) > 0 else ""
    cropped = f"unless they were cropped, the intrinsics are those of another size{such} and must be scaled to theirs"
    if off > _SEEN:
        where = f"lies at the border of images of {width}x{height} or outside"
        return [f"the principal point cx, cy = {cx:g}, {cy:g} {where}: {cropped}"]
    usual = any(abs(theirs[0] - w) <= _SAME * w and abs(theirs[1] - h) <= _SAME * h for w, h in _USUAL)
    if off > 2 * _NEAR and (usual or abs(theirs[0] / width - theirs[1] / height) <= _SAME):
        return [
            f"the principal point cx, cy = {cx:g}, {cy:g} is not in the middle of images of {width}x{height}: {cropped}"
        ]
    return []


def _off_middle(lens: Lens, size: tuple[int, int]) -> float:
    """How far the principal point lies from the middle of images (height, width), in parts of half of a side."""
    (height, width), (_, _, cx, cy) = size, lens.intrinsics
    return max(abs(2 * cx + 1 - width) / width, abs(2 * cy + 1 - height) / height)


def lens_of_matrix(matrix: np.ndarray, size: tuple[int, int]) -> Lens:
    """Of the numbers (9,), (12,) or (16,) of a camera matrix, row by row. Raises ValueError for what no camera has."""
    columns = {9: 3, 12: 4, 16: 4}.get(matrix.size)
    if columns is None:
        raise ValueError(f"a camera matrix has 3x3 or 4x4 numbers, this one has {matrix.size}")
    return Lens((float(matrix[0]), float(matrix[columns + 1]), float(matrix[2]), float(matrix[columns + 2])), size)


def _model(distortion: Sequence[float | str]) -> tuple[tuple[float, ...], bool]:
    """The coefficients, and whether they are of the fisheye model."""
    fisheye = bool(distortion) and distortion[0] == FISHEYE
    numbers = distortion[1:] if fisheye else distortion
    try:
        return tuple(float(v) for v in numbers), fisheye
    except ValueError as error:
        raise ValueError(
            f"distortion is [k1, k2, p1, p2(, k3, ...)] or [{FISHEYE}, k1, k2, k3, k4], got {list(distortion)}"
        ) from error


def lens_for_images(
    intrinsics: Sequence[float] | str, distortion: Sequence[float | str], images: Iterable[Path]
) -> tuple[Lens, list[str]]:
    """`lens_from_option` for the size of the first of `images` whose header can be read.

    "auto" takes the focal length from the EXIF header of the first of the images, where it has one.
    """
    images = list(images)
    size = image_size(images)
    lens = read_exif_lens(images[0]) if intrinsics == "auto" else None
    if lens is None or lens.size != size:
        return lens_from_option(intrinsics, distortion, size)
    return with_distortion(lens, distortion), exif_notices(images[0], lens, distortion)


def with_distortion(lens: Lens, distortion: Sequence[float | str]) -> Lens:
    """The lens with the distortion of the option, where one is given. Raises ValueError for what can be none."""
    coefficients, fisheye = _model(distortion)
    return replace(lens, distortion=coefficients, fisheye=fisheye) if len(distortion) else lens


def exif_notices(path: Path, lens: Lens, distortion: Sequence[float | str]) -> list[str]:
    """What to say of a lens whose focal length is of the EXIF header of the image `path`."""
    doubt = exif_doubt(path)
    return [
        f"intrinsics are from EXIF: focal length {lens.intrinsics[0]:.0f} pixels for {lens.size[1]}x{lens.size[0]}, "
        f"good to a few percent, distortion {'as given' if len(distortion) else 'unknown'}",
        *([doubt] if doubt else []),
    ]


def image_size(images: Iterable[Path]) -> tuple[int, int]:
    """(height, width) of the first image whose header can be read. Raises BadFileError if there is none."""
    first = ""  # what is wrong with it
    for path in images:
        try:
            with opened_image(path, path.name) as opened:
                return upright_size(opened)
        except UnreadableImageError as error:
            first = first or str(error)
    raise BadFileError(
        f"no image could be read ({first or 'there is none'}): their size is needed for their calibration"
    )
