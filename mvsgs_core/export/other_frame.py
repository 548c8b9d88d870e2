"""A map in another frame of reference than its own: metres east, north and up of a place on the Earth, where GPS told
where it lies (georeference.json), or that in which poses were given (given_frame.json)."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvsgs_core import georeference, given_frame
from mvsgs_core.export.cameras import Cameras
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.turning import turned
from mvsgs_core.geometry import Similarity
from mvsgs_core.georeference import Georeference
from mvsgs_core.given_frame import GivenFrame

NAMED_AXES = (".glb", ".spz")  # formats whose y axis is up: writing them turns our axes by half a turn about x
_UP_IS_MINUS_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # so that their y is our up
FILES = (georeference.FILE, given_frame.FILE)


def reference_of(options: argparse.Namespace) -> Georeference | GivenFrame | None:
    """What --frame asks for, of the map's run; None: the map's own frame.

    Raises ValueError where the run had no GPS or given poses, or none that tell.
    """
    if options.frame == "map":
        return None
    if options.scale != 1.0:
        raise ValueError(f"--frame {options.frame} has its own unit: --scale is for a map of an arbitrary one")
    on_earth = options.frame == "enu"
    path: Path = options.map.with_name(georeference.FILE if on_earth else given_frame.FILE)
    if not path.is_file():
        lacking = "had no GPS" if on_earth else "came without poses"
        raise ValueError(
            f"there is no {path.name} beside {options.map}: the frames of the run {lacking}, its report warns why that "
            "does not tell where the map lies, or it has none (evaluator=off, a run that did not end)"
        )
    return georeference.read_georeference(path) if on_earth else given_frame.read_given_frame(path)


def in_axes_of(out: Path, found: Georeference | GivenFrame, cameras: np.ndarray | None) -> tuple[Similarity, str]:
    """Where the map is to be written so that the file has up where its format says, and the file's axes in words.

    cameras: world_from_cam (N, 4, 4) of the map, whose mean up tells that of the given frame; None: it is not known.
    """
    place, on_earth = found.similarity, isinstance(found, Georeference)
    z_is_up = on_earth
    if not on_earth and cameras is not None:
        z_is_up = int(np.argmax(place.rotation @ -cameras[:, :3, 1].mean(axis=0))) == 2
    if out.suffix not in NAMED_AXES or not z_is_up:
        return place, "x east, y north, z up" if on_earth else "axes as given"
    turn = _UP_IS_MINUS_Y
    moved = Similarity(place.scale, turn @ place.rotation, turn @ place.translation)
    return moved, "x east, y up, z south" if on_earth else "axes turned: z as given is y"


def in_frame(final: Snapshot, place: Similarity) -> Snapshot:
    """The map there."""
    scaled = final.scaled(place.scale)
    return replace(
        scaled,
        splats=turned(scaled.splats, place.rotation),
        origin=place.apply(final.origin[None])[0],
        world_from_cam=place.poses(final.world_from_cam),
    )


def cameras_in_frame(cameras: Cameras, place: Similarity) -> Cameras:
    return replace(cameras, world_from_cam=place.poses(cameras.world_from_cam))


def told(out: Path, found: Georeference | GivenFrame, axes: str) -> str:
    """What a user should know of the frame of a file that was written; where on the Earth it lies is put beside it."""
    if isinstance(found, GivenFrame):
        return f"{axes}, in the unit of the {found.poses} poses that were given, {found.distance:.3g} off (median)"
    path = out / "origin.json" if out.is_dir() else out.with_name(out.name + ".origin.json")
    georeference.write_origin(path, found, axes)
    return f"{axes}, in metres, of the place in {path}"
