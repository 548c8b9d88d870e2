"""Where on the Earth a map lies: the similarity from camera positions to their GPS places, robust to false ones.

GPS says nothing about the poses among each other, which matches know better by orders of magnitude: it only gives the
whole of them its unit, its place and its orientation, in metres east, north and up of an origin.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core import geodesy, geometry
from mvsgs_core.atomic_file import replace_text
from mvsgs_core.bad_file import reading
from mvsgs_core.geometry import Similarity
from mvsgs_core.similarity_file import read_similarity, write_similarity

FORMAT = "mvsgs georeference"
FILE = "georeference.json"
FIGURES = ("residual", "farthest", "scale_deviation", "angle_deviation", "position_deviation")
FEWEST = 4  # positions that agree: three always do
SAMPLES = 500  # of three positions each
JUDGES = 1000  # positions, evenly of all, by which they are rated
BEST = 10  # samples that are refined
GATE = 3.0  # times the usual residual: farther off is an outlier (4.6 standard deviations in three dimensions)
FEW = 4.0  # positions beside three, of which the best of many fits flatters: they double the gate, more hardly widen it
MAX_ANGLE = 10.0  # degrees, one standard deviation, about any axis
MOST_ALIKE = 0.98  # successive errors: of more nothing is told
MAX_SCALE = 0.2  # one standard deviation of the unit
LEVEL = 0.3  # sine of the angle of path and vertical, and of path and the cameras' up, above which these tell the roll


class NoReferenceError(ValueError):
    """GPS does not tell where the map lies; the message says why."""


@dataclass(frozen=True)
class Georeference:
    """east_north_up = scale * rotation @ map + translation. Standard deviations count in that errors drift."""

    origin: np.ndarray  # (3,) latitude, longitude (degrees, WGS84), altitude (m, as the source has it)
    scale: float  # m in a unit of the map
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) m
    positions: int  # camera positions with a place
    outliers: int
    residual: float  # m, median distance of all positions
    farthest: float  # m, largest distance
    scale_deviation: float  # of 1
    angle_deviation: float  # degrees, about the axis that is known least
    position_deviation: float  # m, of the whole map
    camera_up: bool = False  # the rotation about the path is not GPS's but that of cameras held upright

    @property
    def similarity(self) -> Similarity:
        """From the map to metres east, north and up."""
        return Similarity(self.scale, self.rotation, self.translation)


def georeference(world_from_cam: np.ndarray, places: np.ndarray, camera_up: bool = False) -> Georeference:
    """Of poses (N, 4, 4), in the order of the stream, and their places (N, 3), in degrees and metres, all known.

    The similarity whose usual residual is least (least quantile of squares, Rousseeuw and Leroy 1987) over samples of
    three, then least squares over the positions within three times it, of few positions more (Umeyama 1991): of four
    and five places a false one is hardly told, it shows in the deviations. camera_up: where the cameras stand on a
    line, the rotation about it, which no position tells, is the one that has them upright.
    Raises NoReferenceError where it is not determined, and says how sure it would be.
    """
    positions = world_from_cam[:, :3, 3]
    if len(positions) < FEWEST:
        raise NoReferenceError(f"{len(positions)} camera positions have a GPS place, {FEWEST} are needed")
    if not geometry.moves(positions):
        raise NoReferenceError("all camera positions coincide")
    origin = geodesy.middle(places)
    target = geodesy.east_north_up(places, origin)
    if not geometry.moves(target):
        raise NoReferenceError(f"all {len(target)} GPS places are the same: the receiver gave none anew")
    similarity, kept = _robust(positions, target)
    if kept.sum() < max(FEWEST, len(kept) / 2):
        raise NoReferenceError(f"of {len(kept)} GPS places {int(kept.sum())} agree with the camera positions")
    residual = similarity.apply(positions) - target
    off = np.linalg.norm(residual, axis=1)
    noise = math.sqrt(float(np.sum(off[kept] ** 2)) / (3 * int(kept.sum()) - 7)) * _drift(residual, kept)
    moved = similarity.apply(positions[kept])
    moved -= moved.mean(axis=0)
    extent, axes = np.linalg.eigh(moved.T @ moved)  # ascending
    scale_deviation = noise / math.sqrt(float(extent.sum()))
    about = np.degrees(noise / np.sqrt(np.maximum([extent[0] + extent[1], extent[0] + extent[2]], 1e-30)))
    length = float(np.ptp(moved @ axes[:, 2]))
    upright = camera_up and about[0] > MAX_ANGLE
    angle = float(about[1] if upright else about[0])
    if scale_deviation > MAX_SCALE or about[1] > MAX_ANGLE:
        raise NoReferenceError(
            f"the path, {length:.1f} m, is too short for GPS that is off by {np.median(off):.1f} m: its unit would be "
            f"known to {100.0 * scale_deviation:.0f} %, its direction to {min(about[1], 180.0):.0f} degrees"
        )
    if upright:
        roll = _upright(axes[:, 2], similarity.rotation @ -world_from_cam[:, :3, 1].mean(axis=0))
        center = positions[kept].mean(axis=0)
        still, rotation = similarity.apply(center[None])[0], roll @ similarity.rotation
        similarity = Similarity(similarity.scale, rotation, still - similarity.scale * rotation @ center)
        off = np.linalg.norm(similarity.apply(positions) - target, axis=1)
    elif angle > MAX_ANGLE:
        raise NoReferenceError(
            f"the camera positions lie nearly on a line, {length:.1f} m long: the rotation about it would be known to "
            f"{min(angle, 180.0):.0f} degrees. evaluator.camera_up=true takes it from cameras that were held upright"
        )
    return Georeference(
        origin, similarity.scale, similarity.rotation, similarity.translation, len(kept), int((~kept).sum()),
        float(np.median(off)), float(off.max()), scale_deviation, angle, noise / math.sqrt(int(kept.sum())), upright,
    )  # fmt: skip


def _drift(residual: np.ndarray, kept: np.ndarray) -> float:
    """By which factor standard deviations grow because errors that follow each other are alike: GPS drifts.

    That of an autoregressive process of the correlation of successive residuals (N, 3), where it is no chance.
    """
    both = kept[1:] & kept[:-1]
    pairs, size = int(both.sum()), float(np.mean(np.sum(residual[kept] ** 2, axis=1)))
    if pairs == 0 or size == 0.0:
        return 1.0
    alike = float(np.sum(residual[1:][both] * residual[:-1][both])) / (pairs * size)
    if alike < 2.0 / math.sqrt(3.0 * pairs):
        return 1.0
    alike = min(alike, MOST_ALIKE)
    return math.sqrt((1.0 + alike) / (1.0 - alike))


def _robust(source: np.ndarray, target: np.ndarray) -> tuple[Similarity, np.ndarray]:
    """Similarity and (N,) bool of those that it was solved from."""
    count = len(source)
    if math.comb(count, 3) <= SAMPLES:
        samples = np.array(list(itertools.combinations(range(count), 3)))
    else:
        samples = np.random.default_rng(0).integers(count, size=(SAMPLES, 3))
    samples = samples[(np.ptp(source[samples], axis=1) > 0.0).any(axis=1)]
    samples = samples[(np.ptp(target[samples], axis=1) > 0.0).any(axis=1)]
    scales, rotations, translations = geometry.umeyama_of_each(source[samples], target[samples])
    some = np.arange(0, count, -(-count // JUDGES))
    off = np.einsum("sij,nj->sni", scales[:, None, None] * rotations, source[some])
    off += translations[:, None] - target[some]
    first = np.argsort(_usual(np.linalg.norm(off, axis=2)), kind="stable")[:BEST]
    gate = GATE * (1.0 + (FEW / (count - 3)) ** 2)
    smallest = 1e-6 * float(np.ptp(target, axis=0).max())  # below it is rounding
    best = None
    for n in first.tolist():
        solved = Similarity(float(scales[n]), rotations[n], translations[n])
        kept = np.zeros(count, bool)
        for _ in range(20):
            off = np.linalg.norm(solved.apply(source) - target, axis=1)
            now = off <= max(gate * float(_usual(off)), smallest)
            if (now == kept).all():
                break
            kept = now
            if not (geometry.moves(source[kept]) and geometry.moves(target[kept])):
                break
            solved = geometry.umeyama(source[kept], target[kept])
        median = float(_usual(np.linalg.norm(solved.apply(source) - target, axis=1)))
        if best is None or median < best[0]:
            best = median, solved, kept
    if best is None:
        raise NoReferenceError("no three camera positions differ whose GPS places do")
    return best[1], best[2]


def _usual(off: np.ndarray) -> np.ndarray:
    """Of residuals (..., N), N >= 4, the median where they are many: of few it is those of the three that were fitted,
    so that it is the second after it."""
    rank = off.shape[-1] // 2 + 1
    return np.asarray(np.partition(off, rank, axis=-1)[..., rank])


def _upright(path: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about the direction of the `path` (3,) that turns the cameras' `up` (3,) as near to ours."""
    ours = np.array([0.0, 0.0, 1.0])
    across, wanted = up - path * (path @ up), ours - path * (path @ ours)
    if np.linalg.norm(across) < LEVEL or np.linalg.norm(wanted) < LEVEL:
        raise NoReferenceError(
            "the path is too steep, or the cameras look along its side, for their up to tell the roll"
        )
    angle = math.atan2(float(path @ np.cross(across, wanted)), float(across @ wanted))
    return geometry.so3_exp(angle * path)


def in_words(found: Mapping[str, Any]) -> dict[str, str]:
    """What a report says of `values_of` a georeference."""
    latitude, longitude, altitude = found["origin"].values()
    about = "about its path from the cameras' up, else " if found["camera_up"] else ""
    return {
        "GPS: distance to the trajectory, median": f"{found['residual']:.2f} m, of {found['positions']} positions, "
        f"of which {found['outliers']} are outliers; at most {found['farthest']:.1f} m",
        "GPS: origin of east, north, up": f"{latitude:.7f}, {longitude:.7f} degrees, {altitude:.2f} m",
        "GPS: how sure, one standard deviation": f"unit {100.0 * found['scale_deviation']:.2g} %, orientation {about}"
        f"{found['angle_deviation']:.2g} degrees, place {found['position_deviation']:.2g} m",
    }


def values_of(found: Georeference) -> dict[str, Any]:
    """As JSON has it; the origin by names."""
    values = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in asdict(found).items()}
    return values | {"origin": dict(zip(("latitude", "longitude", "altitude"), found.origin.tolist()))}


def write_georeference(path: Path, found: Georeference) -> None:
    """Replaces `path` atomically. Raises OSError."""
    said = "metres east, north and up of the origin (WGS84) = scale * rotation * position in map.ply + translation"
    write_similarity(path, FORMAT, said, values_of(found))


def write_origin(path: Path, found: Georeference, axes: str) -> None:
    """Beside a file in the frame of east, north and up, what that is. Raises OSError."""
    content = {
        "frame": "metres east, north and up of the origin (WGS84)", "axes": axes, "origin": values_of(found)["origin"],
        "residual": found.residual, "scale_deviation": found.scale_deviation, "angle_deviation": found.angle_deviation,
        "position_deviation": found.position_deviation,
    }  # fmt: skip
    replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_georeference(path: Path) -> Georeference:
    """What `write_georeference` wrote. Raises BadFileError, saying what is wrong with it, and OSError."""
    content, place = read_similarity(path, FORMAT)
    with reading(path, f"is no {FILE} of this program"):
        origin = np.array([content["origin"][name] for name in ("latitude", "longitude", "altitude")], np.float64)
        if not geodesy.is_place(origin):
            raise ValueError("its origin is no place")
        figures = {name: float(content[name]) for name in FIGURES}
        return Georeference(
            origin=origin, scale=place.scale, rotation=place.rotation, translation=place.translation,
            positions=int(content["positions"]), outliers=int(content["outliers"]),
            camera_up=bool(content["camera_up"]), **figures,
        )  # fmt: skip


__all__ = [
    "FILE", "Georeference", "NoReferenceError", "georeference", "in_words", "read_georeference", "values_of",
    "write_georeference", "write_origin",
]  # fmt: skip
