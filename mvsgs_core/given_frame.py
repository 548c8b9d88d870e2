"""The frame of reference and the unit in which poses were given, by a robot's odometry or a data set, and where a map
that was made without them lies in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.bad_file import reading
from mvsgs_core.geometry import Similarity
from mvsgs_core.similarity_file import read_similarity, write_similarity

FORMAT = "mvsgs given frame"
FILE = "given_frame.json"
FEWEST = 3  # poses
ROUNDS = 5
SMALL = 0.05  # radians: what poses may differ by where the camera hardly turns, over `OTHER`
LEVERS = (1e-3, 10.0)  # of the path's extent: what an angle's error may be worth in distance
OTHER = 0.5  # of how far the camera turned and moved: poses that differ by more are of something else


class NoFrameError(ValueError):
    """The given poses do not tell where the map lies; the message says why."""


@dataclass(frozen=True)
class GivenFrame:
    """given = scale * rotation @ map + translation."""

    similarity: Similarity
    poses: int  # that it was found from
    distance: float  # of a camera from where it was given, median, in the given unit
    angle: float  # degrees, median


def given_frame(world_from_cam: np.ndarray, given: np.ndarray) -> GivenFrame:
    """From poses in the map (N, 4, 4) and the same as they were given (N, 4, 4).

    Least squares of positions (Umeyama 1991) and orientations, each by its own usual error: a path on a line does not
    tell the rotation about it, orientations do. Raises NoFrameError where poses are too few, do not move, or disagree.
    """
    if len(given) < FEWEST:
        raise NoFrameError(f"{len(given)} frames of the map came with a pose, {FEWEST} are needed")
    source, target = world_from_cam[:, :3, 3], given[:, :3, 3]
    if not np.abs(target).max() < geometry.FARTHEST:
        raise NoFrameError("some are no positions")
    if not (geometry.moves(source) and geometry.moves(target)):
        raise NoFrameError("their positions coincide")
    if _turn_otherwise(world_from_cam[:, :3, :3], given[:, :3, :3]):
        raise NoFrameError(
            "they turn otherwise than the camera: a pose must be that of the camera itself (x right, y down, z "
            "forward), not of what carries it"
        )
    axes, given_axes = (np.swapaxes(poses[:, :3, :3], 1, 2) for poses in (world_from_cam, given))  # (N, axis, 3)
    found, away = geometry.umeyama(source, target), np.linalg.norm(target - target.mean(axis=0), axis=1)
    extent = float(away.max())
    for _ in range(ROUNDS):
        off, angles = _differences(found, world_from_cam, given)
        usual = float(np.sqrt(np.mean(angles**2)))
        lever = float(np.clip(np.sqrt(np.mean(off**2)) / max(usual, 1e-12), LEVERS[0] * extent, LEVERS[1] * extent))
        tips = source[:, None] + lever / found.scale * axes
        given_tips = target[:, None] + lever * given_axes
        found = geometry.umeyama(
            np.concatenate([source, tips.reshape(-1, 3)]), np.concatenate([target, given_tips.reshape(-1, 3)])
        )
    off, angles = _differences(found, world_from_cam, given)
    distance = float(np.median(off))
    if distance > OTHER * float(np.median(away)):
        raise NoFrameError(f"they lie {distance:.3g} of their unit from the camera's path, as far as that is long")
    return GivenFrame(found, len(given), distance, float(np.degrees(np.median(angles))))


def _turn_otherwise(rotations: np.ndarray, given: np.ndarray) -> bool:
    """Whether a camera's rotations (N, 3, 3) and the given ones are, in each one's own axes, about others or by others
    than its."""
    turns = geometry.so3_log(np.swapaxes(rotations[:1], 1, 2) @ rotations)
    other = geometry.so3_log(np.swapaxes(given[:1], 1, 2) @ given)
    return bool(np.sum((turns - other) ** 2) > OTHER**2 * max(np.sum(turns**2), len(turns) * SMALL**2))


def _differences(found: Similarity, world_from_cam: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) distances in the given unit, and angles in radians."""
    off = np.linalg.norm(found.apply(world_from_cam[:, :3, 3]) - given[:, :3, 3], axis=1)
    turned = np.swapaxes(given[:, :3, :3], 1, 2) @ found.rotation @ world_from_cam[:, :3, :3]
    return off, np.linalg.norm(geometry.so3_log(turned), axis=1)


def values_of(found: GivenFrame) -> dict[str, Any]:
    """As JSON has it."""
    place = found.similarity
    return {
        "scale": place.scale, "rotation": place.rotation.tolist(), "translation": place.translation.tolist(),
        "poses": found.poses, "distance": found.distance, "angle": found.angle,
    }  # fmt: skip


def in_words(found: Mapping[str, Any]) -> dict[str, str]:
    """What a report says of `values_of` a given frame."""
    return {
        "given poses: distance to the trajectory, median": f"{found['distance']:.4g} of their unit, of "
        f"{found['poses']} poses; turned by {found['angle']:.2g} degrees",
        "given poses: one unit of the map": f"{found['scale']:.4g} of theirs",
    }


def write_given_frame(path: Path, found: GivenFrame) -> None:
    """Replaces `path` atomically. Raises OSError."""
    said = "position as poses were given = scale * rotation * position in map.ply + translation"
    write_similarity(path, FORMAT, said, values_of(found))


def read_given_frame(path: Path) -> GivenFrame:
    """What `write_given_frame` wrote. Raises BadFileError, saying what is wrong with it, and OSError."""
    content, place = read_similarity(path, FORMAT)
    with reading(path, f"is no {FILE} of this program"):
        return GivenFrame(place, int(content["poses"]), float(content["distance"]), float(content["angle"]))


__all__ = [
    "FILE", "GivenFrame", "NoFrameError", "given_frame", "in_words", "read_given_frame", "values_of",
    "write_given_frame",
]  # fmt: skip
