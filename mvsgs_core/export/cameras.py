"""cameras.json: the keyframes of a map as cameras, so that whoever opens a map.ply knows what it was seen with."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.atomic_file import replace_text
from mvsgs_core.export.source_camera import SourceCamera, camera_of, camera_values

FORMAT, VERSION = "mvsgs cameras", 1


@dataclass(frozen=True)
class Cameras:
    """K keyframes, in the order of the stream. Pinhole, undistorted; pixel (0, 0) is the center of the first pixel."""

    keyframes: np.ndarray  # (K,) int64 index of the frame in its stream
    timestamps: np.ndarray  # (K,) float64 seconds, NaN where not known
    world_from_cam: np.ndarray  # (K, 4, 4) float64, camera axes x right, y down, z forward; the world of map.ply
    intrinsics: np.ndarray  # (K, 4) float64 fx, fy, cx, cy in pixels at `sizes`, as the tracker estimated them
    sizes: np.ndarray  # (K, 2) int64 height, width of the image
    exposures: np.ndarray  # (K, 3, 4) float64 [A | b]: the image shows A color + b of the map's color, both in [0, 1]
    vignetting: np.ndarray | None = None  # (3,) float64 of the sensor, see `photometry`; None: none

    def __len__(self) -> int:
        return len(self.keyframes)

    def chosen(self, which: np.ndarray | slice) -> Cameras:
        """Copies of some of them."""
        of_each = {name: value for name, value in vars(self).items() if name != "vignetting"}
        return replace(self, **{name: value[which].copy() for name, value in of_each.items()})


def write_cameras(path: Path, cameras: Cameras, source: SourceCamera | None = None) -> None:
    """Replaces `path` atomically: what stood there stays until the new file is whole. Raises OSError.

    source: the camera that took the images, before they were undistorted and resized; None: not known.
    """
    keyframes = [
        {
            "index": int(cameras.keyframes[k]),
            "timestamp": float(cameras.timestamps[k]) if np.isfinite(cameras.timestamps[k]) else None,
            "world_from_cam": cameras.world_from_cam[k].tolist(),
            "intrinsics": cameras.intrinsics[k].tolist(),
            "size": cameras.sizes[k].tolist(),
            "exposure": cameras.exposures[k].tolist(),
        }
        for k in range(len(cameras))
    ]
    camera = None if source is None else camera_values(source)
    lens = {} if cameras.vignetting is None else {"vignetting": cameras.vignetting.tolist()}
    content = {"format": FORMAT, "version": VERSION, "camera": camera, **lens, "keyframes": keyframes}
    text = json.dumps(content, allow_nan=False)
    replace_text(path, text.replace(' {"index"', '\n{"index"') + "\n")  # a keyframe a line


def read_cameras(path: Path) -> Cameras:
    """The cameras that `write_cameras` wrote. Raises ValueError, saying what is wrong with the file, and OSError."""
    content = _content(path)
    keyframes = content.get("keyframes")
    if not isinstance(keyframes, list) or not all(isinstance(entry, dict) for entry in keyframes):
        raise ValueError(f"{path}: `keyframes` must be a list of objects")
    result = Cameras(
        keyframes=_numbers(path, keyframes, "index", ()).astype(np.int64),
        timestamps=_numbers(path, keyframes, "timestamp", (), unknown=True),
        world_from_cam=_numbers(path, keyframes, "world_from_cam", (4, 4)),
        intrinsics=_numbers(path, keyframes, "intrinsics", (4,)),
        sizes=_numbers(path, keyframes, "size", (2,)).astype(np.int64),
        exposures=_numbers(path, keyframes, "exposure", (3, 4)),
        vignetting=_vignetting(path, content.get("vignetting")),
    )
    if (result.sizes < 1).any() or (result.intrinsics[:, :2] <= 0).any():
        raise ValueError(f"{path}: sizes and focal lengths must be positive")
    return result


def read_source_camera(path: Path) -> SourceCamera | None:
    """The camera that took the images; None where the file does not say it. Raises ValueError and OSError."""
    values = _content(path).get("camera")
    if values is None:
        return None
    try:
        if not isinstance(values, dict):
            raise ValueError("it is no object")
        return camera_of(values)
    except ValueError as error:
        raise ValueError(f"{path}: `camera`: {error}") from error


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="ascii"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no cameras.json: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} is no cameras.json of this program")
    if content.get("version") != VERSION:
        raise ValueError(f"{path} has version {content.get('version')!r}: this program reads {VERSION}")
    return content


def _numbers(
    path: Path, entries: list[dict[str, Any]], name: str, shape: tuple[int, ...], *, unknown: bool = False
) -> np.ndarray:
    """(K, *shape) float64 of one property; null is NaN where it may be unknown."""
    values = []
    for k, entry in enumerate(entries):
        given = entry.get(name)
        if given is None and unknown:
            values.append(np.full(shape, np.nan))
            continue
        try:
            value = _finite(given, shape)
        except (TypeError, ValueError, OverflowError):
            wanted = " x ".join(str(n) for n in shape) or "1"
            raise ValueError(f"{path}: keyframe {k} has no `{name}` of {wanted} finite numbers") from None
        values.append(value)
    return np.array(values, dtype=np.float64).reshape(len(entries), *shape)


def _vignetting(path: Path, given: Any) -> np.ndarray | None:
    try:
        return None if given is None else _finite(given, (3,))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{path}: `vignetting` must be 3 finite numbers") from None


def _finite(given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Float64. Raises TypeError, ValueError or OverflowError for what is no such array."""
    value = np.array(given, dtype=np.float64)
    if value.shape != shape or not np.isfinite(value).all():
        raise ValueError("another shape, or not finite")
    return value
