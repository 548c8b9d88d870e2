"""A map in metres east, north and up of a place on the Earth, where GPS told where it lies (georeference.json)."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvsgs_core import georeference
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.turning import turned
from mvsgs_core.georeference import Georeference

NAMED_AXES = (".glb", ".spz")  # formats whose y axis is up: writing them turns our axes by half a turn about x
_UP_IS_MINUS_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # so that their y is our up


def reference_of(options: argparse.Namespace) -> Georeference | None:
    """What --frame asks for, of the map's run, for the axes of OUT; None: the map's own frame.

    Raises ValueError where the run had no GPS, or none that tells.
    """
    if options.frame == "map":
        return None
    if options.scale != 1.0:
        raise ValueError("--frame enu is in metres: --scale is for a map of an arbitrary unit")
    path: Path = options.map.with_name(georeference.FILE)
    if not path.is_file():
        raise ValueError(
            f"there is no {georeference.FILE} beside {options.map}: the frames of the run had no GPS, or its report "
            "warns why that does not tell where the map lies"
        )
    return georeference.read_georeference(path)


def in_axes_of(out: Path, found: Georeference) -> tuple[Georeference, str]:
    """The frame that is to be written so that the file has up where its format says, and the file's axes in words."""
    if out.suffix not in NAMED_AXES:
        return found, "x east, y north, z up"
    turn = _UP_IS_MINUS_Y
    moved = replace(found, rotation=turn @ found.rotation, translation=turn @ found.translation)
    return moved, "x east, y up, z south"


def on_earth(final: Snapshot, found: Georeference) -> Snapshot:
    """The map in that frame."""
    scaled = final.scaled(found.scale)
    return replace(
        scaled,
        splats=turned(scaled.splats, found.rotation),
        origin=found.world(final.origin[None])[0],
        world_from_cam=found.poses(final.world_from_cam),
    )


def cameras_on_earth(cameras: Cameras, found: Georeference) -> Cameras:
    return replace(cameras, world_from_cam=found.poses(cameras.world_from_cam))


def write_origin(out: Path, found: Georeference, axes: str) -> Path:
    """OUT.origin.json, or origin.json in a folder: returns its path."""
    path = out / "origin.json" if out.is_dir() else out.with_name(out.name + ".origin.json")
    georeference.write_origin(path, found, axes)
    return path
