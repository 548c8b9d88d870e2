"""What the EXIF header of a photograph tells: intrinsics, good to a few percent, and its exposure."""

from __future__ import annotations

import math
from pathlib import Path

from mvsgs_core.datasets.files import UnreadableImageError, opened_image, upright_size
from mvsgs_core.datasets.lens import Lens

_EXIF_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405  # millimeters
_EXPOSURE_TIME, _F_NUMBER, _SENSITIVITY = 0x829A, 0x829D, 0x8827  # seconds, -, ISO
_PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210  # sensor pixels per unit
_PIXEL_WIDTH, _PIXEL_HEIGHT = 0xA002, 0xA003  # of the picture as taken
_UNIT_MILLIMETERS = {2: 25.4, 3: 10.0, 4: 1.0}
_DIAGONAL_35MM = math.hypot(36.0, 24.0)  # CIPA DCG-001: "35 mm equivalent" compares diagonals


def read_exif_lens(path: Path) -> Lens | None:
    """Focal length from the header, principal point in the middle, no distortion; None where the header lacks it.

    A header that cannot be read, or tells of a focal length that no camera has, is one that lacks it.
    Prefers focal length times the resolution of the sensor, which is exact for a picture that was scaled but not
    cropped, over the 35 mm equivalent, which is rounded to whole millimeters.
    """
    try:
        with opened_image(path, path.name) as image:
            header = image.getexif().get_ifd(_EXIF_IFD)
            height, width = upright_size(image)
    except UnreadableImageError:
        return None  # reading the sequence reports it
    focal = _from_sensor(header, max(height, width))
    if focal is None:
        focal_35mm = _positive(header.get(_FOCAL_LENGTH_35MM))
        if focal_35mm is None:
            return None
        focal = focal_35mm * math.hypot(width, height) / _DIAGONAL_35MM
    try:
        return Lens((focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)), (height, width))
    except ValueError:  # a focal length that no camera has
        return None


def read_exif_exposure(path: Path) -> float:
    """Exposure time (s) times ISO over the f-number squared; 0 where the header lacks one of them or cannot be read."""
    try:
        with opened_image(path, path.name) as image:
            header = image.getexif().get_ifd(_EXIF_IFD)
    except UnreadableImageError:
        return 0.0
    sensitivity = header.get(_SENSITIVITY)
    if isinstance(sensitivity, tuple):  # of several kinds, the first is the one that counts
        sensitivity = sensitivity[0] if sensitivity else None
    seconds, stop, iso = (_positive(v) for v in (header.get(_EXPOSURE_TIME), header.get(_F_NUMBER), sensitivity))
    if seconds is None or stop is None or iso is None:
        return 0.0
    return _positive(seconds * iso / stop**2) or 0.0


def _from_sensor(header: dict[int, object], longer_side: int) -> float | None:
    focal, resolution = _positive(header.get(_FOCAL_LENGTH)), _positive(header.get(_PLANE_X_RESOLUTION))
    sides = [_positive(header.get(tag)) for tag in (_PIXEL_WIDTH, _PIXEL_HEIGHT)]
    unit = _UNIT_MILLIMETERS.get(int(_positive(header.get(_PLANE_UNIT)) or 2))
    if focal is None or resolution is None or unit is None or sides[0] is None or sides[1] is None:
        return None
    return focal * resolution / unit * longer_side / max(sides[0], sides[1])


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
