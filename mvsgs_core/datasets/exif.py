"""What the EXIF header of a photograph tells: intrinsics, good to a few percent, exposure, time, and GPS."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

import numpy as np

from mvsgs_core import geodesy
from mvsgs_core.datasets.files import UnreadableImageError, exif_of, opened_image, upright_size
from mvsgs_core.datasets.lens import Lens

_EXIF_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405  # millimeters
_EXPOSURE_TIME, _F_NUMBER, _SENSITIVITY = 0x829A, 0x829D, 0x8827  # seconds, -, ISO
_PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210  # sensor pixels per unit
_PIXEL_WIDTH, _PIXEL_HEIGHT = 0xA002, 0xA003  # of the picture as taken
_UNIT_MILLIMETERS = {2: 25.4, 3: 10.0, 4: 1.0}
_TAKEN, _TAKEN_FRACTION, _TAKEN_OFFSET = 0x9003, 0x9291, 0x9011  # DateTimeOriginal, of the camera's own clock
_GPS_IFD = 0x8825
_LATITUDE, _LONGITUDE, _ALTITUDE = (1, 2), (3, 4), (5, 6)  # tags of reference and value
_BELOW = (1, 3)  # references of altitudes below the sea, below the ellipsoid (EXIF 3.0)
_APART = 1.15  # or its inverse, of two focal lengths: rounding and another shape of sensor make less
_SHAPES = (3 / 2, 4 / 3, 16 / 9)  # of sensors
_CROPPED = 2.0  # the first over the second at most, where a picture was cropped: half of what the sensor saw is left
_NARROW = math.radians(10.0)  # across the longer side: as a 200 mm lens has
_DIAGONAL_35MM = math.hypot(36.0, 24.0)  # CIPA DCG-001: "35 mm equivalent" compares diagonals


def read_exif_lens(path: Path, *, turn_upright: bool = True) -> Lens | None:
    """Focal length from the header, principal point in the middle, no distortion; None where the header lacks it.

    A header that cannot be read, or tells of a focal length that no camera has, is one that lacks it.
    Prefers focal length times the resolution of the sensor, which is exact for a picture that was scaled but not
    cropped, over the 35 mm equivalent, which is rounded to whole millimeters and is of the whole sensor. Where both
    contradict each other, the resolution is of another size of the picture, unless its shape is no sensor's and a crop
    explains the difference. Alone, the resolution must be of no narrower view than nearly all lenses have.
    turn_upright: the lens is of the image as the header says it should be shown.
    """
    try:
        with opened_image(path, path.name) as image:
            header = exif_of(image).get_ifd(_EXIF_IFD)
            height, width = upright_size(image) if turn_upright else (image.height, image.width)
    except UnreadableImageError:
        return None  # reading the sequence reports it
    focal, _ = _focal_length(header, (height, width))
    if focal is None:
        return None
    try:
        return Lens((focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)), (height, width))
    except ValueError:  # a focal length that no camera has
        return None


def exif_doubt(path: Path) -> str:
    """What to say of a header that names two focal lengths, or one that is hardly true; empty where it does not."""
    try:
        with opened_image(path, path.name) as image:
            _, doubt = _focal_length(exif_of(image).get_ifd(_EXIF_IFD), (image.height, image.width))
    except UnreadableImageError:
        return ""
    return f"EXIF of {path.name} {doubt}" if doubt else ""


def _focal_length(header: dict[int, object], size: tuple[int, int]) -> tuple[float | None, str]:
    """Pixels of an image (height, width), None where it is not known; and what is doubtful in it, for a notice."""
    equivalent = _positive(header.get(_FOCAL_LENGTH_35MM))
    by_35mm = None if equivalent is None else equivalent * math.hypot(*size) / _DIAGONAL_35MM
    by_sensor = _from_sensor(header, max(size))
    if by_sensor is None:
        return by_35mm, ""
    angle = 2.0 * math.atan(0.5 * max(size) / by_sensor)
    if by_35mm is None:
        if angle >= _NARROW:
            return by_sensor, ""
        return None, (
            f"names a focal length of {by_sensor:.0f} pixels, {math.degrees(angle):.1f} degrees across the picture, as "
            "of one that was scaled: it is taken to be unknown"
        )
    if 1.0 / _APART < by_sensor / by_35mm < _APART:
        return by_sensor, ""
    told = f"contradicts itself: by the sensor's resolution the focal length is {by_sensor:.0f} pixels"
    of_a_sensor = any(math.isclose(max(size) / min(size), shape, rel_tol=0.01) for shape in _SHAPES)
    if not of_a_sensor and angle >= _NARROW and 1.0 < by_sensor / by_35mm <= _CROPPED:
        return by_sensor, f"{told}, which is taken, as the picture was cropped; by the 35 mm equivalent {by_35mm:.0f}"
    return by_35mm, f"{told}, as of a picture that was scaled; that of the 35 mm equivalent is taken, {by_35mm:.0f}"


def read_exif_time(path: Path) -> datetime | None:
    """When a photograph was taken, by the camera's clock: with its zone where the header names one.

    None where the header lacks it, or cannot be read.
    """
    header = _part(path, _EXIF_IFD)
    text, fraction, offset = (_text(header.get(tag)) for tag in (_TAKEN, _TAKEN_FRACTION, _TAKEN_OFFSET))
    day, _, time = text.partition(" ")
    seconds = f".{fraction[:6]}" if fraction.isdecimal() else ""
    for zone in (offset, ""):  # some cameras write blanks there
        try:
            return datetime.fromisoformat(f"{day.replace(':', '-')}T{time}{seconds}{zone}")
        except ValueError:
            continue
    return None


def _part(path: Path, tag: int) -> dict[int, object]:
    """What the header has at `tag`; nothing where it cannot be read."""
    try:
        with opened_image(path, path.name) as image:
            return exif_of(image).get_ifd(tag)
    except UnreadableImageError:
        return {}


def _text(value: object) -> str:
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.replace("\0", " ").strip() if isinstance(text, str) else ""


def read_exif_exposure(path: Path) -> float:
    """Exposure time (s) times ISO over the f-number squared; 0 where the header lacks one of them or cannot be read."""
    header = _part(path, _EXIF_IFD)
    sensitivity = header.get(_SENSITIVITY)
    if isinstance(sensitivity, tuple):  # of several kinds, the first is the one that counts
        sensitivity = sensitivity[0] if sensitivity else None
    seconds, stop, iso = (_positive(v) for v in (header.get(_EXPOSURE_TIME), header.get(_F_NUMBER), sensitivity))
    if seconds is None or stop is None or iso is None:
        return 0.0
    return _positive(seconds * iso / stop**2) or 0.0


def read_exif_place(path: Path) -> np.ndarray | None:
    """(3,) latitude, longitude (degrees) and altitude (m, above the sea or the ellipsoid), NaN without an altitude.

    None where the header lacks a place, has one that can be none, or cannot be read.
    """
    header = _part(path, _GPS_IFD)
    latitude, longitude = _angle(header, _LATITUDE, "NS"), _angle(header, _LONGITUDE, "EW")
    if latitude is None or longitude is None:
        return None
    altitude, below = _number(header.get(_ALTITUDE[1])), header.get(_ALTITUDE[0])
    below = below[0] if isinstance(below, bytes) and below else below
    if altitude is None:
        return (
            np.array([latitude, longitude, np.nan]) if geodesy.is_place(np.array([latitude, longitude, 0.0])) else None
        )
    place = np.array([latitude, longitude, -altitude if below in _BELOW else altitude])
    return place if geodesy.is_place(place) else None


def _angle(header: dict[int, object], tags: tuple[int, int], signs: str) -> float | None:
    """Degrees of degrees, minutes and seconds, some of which may be left out; negative by the reference."""
    sign, value = header.get(tags[0]), header.get(tags[1])
    sign = sign.decode("ascii", "replace") if isinstance(sign, bytes) else sign
    parts = [_number(part) for part in value] if isinstance(value, tuple) else []
    if not isinstance(sign, str) or sign[:1].upper() not in tuple(signs) or not 1 <= len(parts) <= 3 or None in parts:
        return None
    degrees = sum(part / 60.0**n for n, part in enumerate(parts) if part is not None)
    return -degrees if sign[:1].upper() == signs[1] else degrees


def _from_sensor(header: dict[int, object], longer_side: int) -> float | None:
    focal, resolution = _positive(header.get(_FOCAL_LENGTH)), _positive(header.get(_PLANE_X_RESOLUTION))
    sides = [_positive(header.get(tag)) for tag in (_PIXEL_WIDTH, _PIXEL_HEIGHT)]
    unit = _UNIT_MILLIMETERS.get(int(_positive(header.get(_PLANE_UNIT)) or 2))
    if focal is None or resolution is None or unit is None or sides[0] is None or sides[1] is None:
        return None
    return focal * resolution / unit * longer_side / max(sides[0], sides[1])


def _positive(value: object) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None
