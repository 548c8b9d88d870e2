"""The camera that took a stream: intrinsics of its original images, as they were given or as the run found them.

The readers and the tracker say what they know in their statistics; the mapper writes it into cameras.json. Its focal
length can be given to the next run as `dataset.intrinsics`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mvsgs_core.camera import check_intrinsics, is_readout_time, told_readout_time
from mvsgs_core.datasets.lens import Lens

GIVEN, ESTIMATED, GUESSED = "given", "estimated", "guessed"  # by the user or the data set; by the tracker; by nobody
FACTOR = "focal length over its guess"  # so the tracker counts it
PHOTOGRAPHS = "lens of the photographs"  # so their tracker says [factor on the focal lengths, k1, k2]
UNTESTED = "it is a guess that nothing has tested"
LENS = "lens"  # under this name a source says its lens, `lens_values`


@dataclass(frozen=True)
class SourceCamera:
    """Raises ValueError for numbers that no camera has."""

    lens: Lens  # of the original image, with the focal lengths as they were used
    origin: str  # of the focal lengths: given, estimated or guessed
    focal_sigma: float | None = None  # standard deviation of the focal length over itself; None: not known
    doubt: str = ""  # why the focal length is not to be relied on; empty: nothing speaks against it
    readout_time: float | None = None  # seconds of the rolling shutter, first row to last; 0: none; None: not known
    radial: tuple[float, float] | None = None  # k1 that was found and left in, its deviation; None: not looked for
    reads_columns: bool = False  # the rolling shutter reads columns, not rows

    def __post_init__(self) -> None:
        if self.origin not in (GIVEN, ESTIMATED, GUESSED):
            raise ValueError(f"`origin` is given, estimated or guessed, not {self.origin!r}")
        if self.focal_sigma is not None and not (np.isfinite(self.focal_sigma) and self.focal_sigma >= 0):
            raise ValueError(f"`focal_sigma` is {self.focal_sigma}")
        if self.readout_time is not None and not is_readout_time(self.readout_time):
            raise ValueError(f"`readout_time` is {self.readout_time}")
        if self.radial is not None and not (np.isfinite(self.radial).all() and self.radial[1] >= 0):
            raise ValueError(f"`radial` is {self.radial}")

    def text(self) -> str:
        """In words, for people."""
        fx, fy = self.lens.intrinsics[:2]
        focal = f"{fx:.1f} px" if abs(fx - fy) < 0.05 else f"{fx:.1f} and {fy:.1f} px"
        sigma = "" if self.focal_sigma is None else f", give or take {100 * self.focal_sigma:.1f} %"
        parts = [f"focal length {focal} at {self.lens.size[1]}x{self.lens.size[0]}, {self.origin}{sigma}"]
        if self.lens.distorted:
            parts.append("distortion " + ", ".join(f"{k:g}" for k in self.lens.distortion))
        if self.radial is not None:
            parts.append(f"radial distortion {self.radial[0]:.3f}, give or take {self.radial[1]:.3f}, left in")
        if self.readout_time:
            parts.append(f"rolling shutter of {told_readout_time(self.readout_time, reads_columns=self.reads_columns)}")
        if self.doubt:
            parts.append(f"doubtful: {self.doubt}")
        return "; ".join(parts)


def lens_values(lens: Lens) -> dict[str, Any]:
    """As a source says it in its statistics."""
    return {
        "intrinsics": list(lens.intrinsics),
        "size": list(lens.size),
        "distortion": list(lens.distortion),
        "fisheye": lens.fisheye,
        "guessed": lens.guessed,
    }


def source_camera(statistics: Mapping[str, Any]) -> SourceCamera | None:
    """Of the statistics of all nodes upstream, by name; None where no source said its lens, or what no camera has."""
    values: dict[str, Any] = {}
    for stats in statistics.values():
        for part in ("counts", "values"):
            said = stats.get(part) if isinstance(stats, Mapping) else None
            values |= said if isinstance(said, Mapping) else {}
    try:
        lens = _lens(values[LENS])
        sigma, readout = values.get("focal_sigma_percent"), values.get("readout_time")
        shared = values.get(PHOTOGRAPHS)
        found = shared is not None or (lens.guessed and sigma is not None)
        error = float(sigma) / 100.0 if found and sigma is not None else None
        factor, k1, k2 = (float(v) for v in shared or ((values[FACTOR] if found else 1.0), 0.0, 0.0))
        if (k1 or k2) and not lens.distorted:  # of a lens that bends beyond what was given, both cannot be said as one
            lens = replace(lens, distortion=(k1, k2, 0.0, 0.0))
        fx, fy, cx, cy = lens.intrinsics
        doubt = str(values.get("focal_doubt") or ("" if found or not lens.guessed else UNTESTED))
        left, sure = values.get("radial_k1"), values.get("radial_k1_sigma")
        radial = (float(left), float(sure)) if found and left is not None and sure is not None else None
        camera = SourceCamera(
            replace(lens, intrinsics=(factor * fx, factor * fy, cx, cy), guessed=lens.guessed and not found),
            ESTIMATED if found else GUESSED if lens.guessed else GIVEN,
            error, doubt, None if readout is None else float(readout), radial,
            bool(values.get("reads_columns", False)),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return camera


def camera_values(camera: SourceCamera) -> dict[str, Any]:
    """As it stands in cameras.json."""
    return lens_values(camera.lens) | {
        "origin": camera.origin,
        "focal_sigma": camera.focal_sigma,
        "doubt": camera.doubt,
        "readout_time": camera.readout_time,
        "reads_columns": camera.reads_columns,
        "radial": None if camera.radial is None else list(camera.radial),
    }


def camera_of(values: Mapping[str, Any]) -> SourceCamera:
    """What `camera_values` made. Raises ValueError for what it did not."""
    try:
        sigma, readout, radial = values["focal_sigma"], values["readout_time"], values["radial"]
        if radial is not None and not (isinstance(radial, list) and len(radial) == 2):
            raise ValueError(f"`radial` is {radial!r}")
        return SourceCamera(
            _lens(values), str(values["origin"]), None if sigma is None else float(sigma), str(values["doubt"]),
            None if readout is None else float(readout),
            None if radial is None else (float(radial[0]), float(radial[1])),
            bool(values["reads_columns"]),
        )  # fmt: skip
    except KeyError as error:
        raise ValueError(f"`{error.args[0]}` is missing") from error
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{error!r}") from error


def _lens(values: Mapping[str, Any]) -> Lens:
    fx, fy, cx, cy = (float(value) for value in values["intrinsics"])
    height, width = (int(value) for value in values["size"])
    check_intrinsics(np.array([fx, fy, cx, cy]), (height, width))
    return Lens(
        (fx, fy, cx, cy), (height, width), tuple(float(k) for k in values["distortion"]), bool(values["fisheye"]),
        bool(values["guessed"]),
    )  # fmt: skip
