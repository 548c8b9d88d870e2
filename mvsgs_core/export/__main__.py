"""Turns a map.ply into other formats: `python -m mvsgs_core.export MAP.ply OUT`.

OUT decides: gaussians.ply (--fold, for viewers without shapes), .splat, .spz, a mesh (.glb, .obj, or --mesh with .ply),
a folder for a COLMAP model, with --images and --observations where they are wanted, transforms.json for nerfstudio,
cameras.json, or trajectory.txt (TUM format). Mesh, model and these are of the keyframes in the cameras.json beside the
map, or of a --trajectory. --frame enu: in metres east, north and up, where the run had GPS; given: in the frame and
unit of the poses that came with its frames.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mvsgs_core.atomic_file import replacing
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras, read_source_camera, write_cameras
from mvsgs_core.export.colmap import write_colmap
from mvsgs_core.export.command_line import cameras_of_map, input_arguments, known_cameras, read_map, run
from mvsgs_core.export.image_sizes import check_sizes
from mvsgs_core.export.mesh import write_mesh
from mvsgs_core.export.other_frame import FILES, cameras_in_frame, in_axes_of, in_frame, reference_of, told
from mvsgs_core.export.ply import relative_origin, write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.splat import WRITERS, spz_origin
from mvsgs_core.export.transforms import write_transforms
from mvsgs_core.export.turning import RUB_FROM_RDF
from mvsgs_core.trajectory_file import write_trajectory

BESIDE = Path()  # --images without a folder: those beside the map


def posed_cameras(options: argparse.Namespace) -> Cameras:
    """Those of the map, in the frame that is written."""
    found = cameras_of_map(options)
    return found if options.place is None else cameras_in_frame(found, options.place)


def splats(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    if out.suffix == ".ply":
        write_ply(out, final, fold=options.fold)
    else:
        WRITERS[out.suffix](out, final)
    shaped = out.suffix == ".ply" and final.kernel != "gaussian" and not options.fold
    silent = final.antialiased and out.suffix != ".spz"
    told = "; shaped: other viewers need --fold" if shaped else ""
    told += "; antialiased: a viewer must be told, or shows it too bright" if silent else ""
    origin = RUB_FROM_RDF @ spz_origin(final) if out.suffix == ".spz" else relative_origin(final)
    if origin.any():
        told += (
            f"; positions are relative to {' '.join(f'{value:.12g}' for value in origin)}, as the format holds no more"
        )
    return f"{len(final.splats)} splats, {out.stat().st_size} bytes{told}"


def mesh(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    vertices, triangles = write_mesh(out, final, posed_cameras(options), options.voxel)
    return f"{vertices} vertices, {triangles} triangles"


def colmap(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    if options.images is not None and options.trajectory is not None:
        raise ValueError("--images are those of the keyframes, of which a --trajectory knows nothing")
    images = options.map.with_name(keyframe_images.FOLDER) if options.images is BESIDE else options.images
    written = write_colmap(out, final, posed_cameras(options), images, options.observations)
    said = f"{written.images} images, {written.points} points, {written.observations} observations"
    return f"{said}{_left_out(written.left_out, images)}"


def _left_out(count: int, images: Path | None) -> str:
    return f"; {count} keyframes without an image in {images} were left out" if count else ""


def transforms(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    if options.trajectory is not None:
        raise ValueError(
            f"{out.name} names the keyframes' images, of which a --trajectory knows nothing: leave --trajectory out"
        )
    given = options.images is not None and options.images is not BESIDE
    images = options.images if given else options.map.with_name(keyframe_images.FOLDER)
    cameras = posed_cameras(options)
    check_sizes(images, cameras)
    there = write_transforms(out, cameras, images)
    if not there:
        return f"{len(cameras)} cameras, of which 0 have their image in {images}"
    return f"{there} cameras{_left_out(len(cameras) - there, images)}"


def cameras(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    found, beside = posed_cameras(options), options.cameras or options.map.with_name("cameras.json")
    write_cameras(out, found, read_source_camera(beside) if beside.is_file() else None)
    return f"{len(found)} cameras"


def trajectory(out: Path, final: Snapshot, options: argparse.Namespace) -> str:
    found = posed_cameras(options)
    known = np.isfinite(found.timestamps) & (found.keyframes >= 0)
    if not known.any():
        raise ValueError("no keyframe of this stream has a time, without which a trajectory has no poses")
    with replacing(out, sync=False) as aside:
        write_trajectory(aside, found.timestamps[known], found.world_from_cam[known])
    left_out = int((~known).sum())
    said = f"; {left_out} keyframes of a stream before, or without a time, were left out" if left_out else ""
    return f"{len(found) - left_out} poses{said}"


class Format(NamedTuple):
    name: str
    write: Callable[[Path, Snapshot, argparse.Namespace], str]  # returns what is in the file
    reads: tuple[str, ...]  # of the options that not all formats read


_POSED = ("cameras", "size", "intrinsics", "trajectory", "every")
MESH = Format("a mesh", mesh, (*_POSED, "antialiased", "voxel"))
TRANSFORMS = Format("transforms.json", transforms, (*_POSED, "images"))
FORMATS = {  # by the suffix of OUT, of which a folder has none
    ".ply": Format("a .ply of splats", splats, ("antialiased", "fold")),
    ".splat": Format(".splat", splats, ("antialiased",)), ".spz": Format(".spz", splats, ("antialiased",)),
    ".glb": MESH, ".obj": MESH, ".stl": MESH, ".off": MESH,
    ".json": Format("cameras.json", cameras, _POSED), ".txt": Format("a trajectory", trajectory, _POSED),
    "": Format("a COLMAP model", colmap, (*_POSED, "antialiased", "images", "observations")),
}  # fmt: skip


def _format(out: Path, options: argparse.Namespace, unset: Callable[[str], object]) -> Format:
    """Raises ValueError where there is none of that name, or it does not read an option that was given."""
    named = TRANSFORMS if out.suffix == ".json" and out.name != "cameras.json" else FORMATS.get(out.suffix)
    wanted = MESH if options.mesh else named
    if wanted is None:
        raise ValueError(f"no format {out.suffix!r}; there are: {', '.join(filter(None, FORMATS))}, a folder")
    known = list(dict.fromkeys([*FORMATS.values(), TRANSFORMS]))
    for option in dict.fromkeys(name for each in known for name in each.reads):
        if option not in wanted.reads and getattr(options, option) != unset(option):
            readers = ", ".join(each.name for each in known if option in each.reads)
            raise ValueError(f"--{option} is not for {wanted.name}: leave it out; it is for {readers}")
    return wanted


def _check_not_read(out: Path, options: argparse.Namespace) -> None:
    """Raises ValueError where `out` would replace a file that it is made from, or cannot be."""
    if not out.absolute().parent.is_dir():
        raise ValueError(f"{out}: there is no folder {out.parent}")
    cameras = options.cameras or options.map.with_name("cameras.json")
    beside = [options.map.with_name(name) for name in FILES]
    for path in filter(None, (options.map, cameras, options.trajectory, *beside)):
        if path.exists() and out.resolve() == path.resolve():
            raise ValueError(f"{out} is read for this export, which would replace it: give another file")


def export(options: argparse.Namespace, unset: Callable[[str], object]) -> str:
    """Does what the command line asks; returns one line that says what was written. Raises ValueError, OSError.

    unset: the value of an option that was not given.
    """
    if not (math.isfinite(options.scale) and options.scale > 0):
        raise ValueError("--scale must be positive")
    if not (math.isfinite(options.voxel) and options.voxel > 0):
        raise ValueError("--voxel must be positive")
    out: Path = options.out
    write = _format(out, options, unset).write
    _check_not_read(out, options)
    out = out.resolve() if out.is_symlink() else out  # what it leads to is replaced, and not the link
    final, left_out = read_map(options)
    found, options.place = reference_of(options), None
    if found is None:
        return f"{out}: {write(out, final.scaled(options.scale), options)}{left_out}"
    cameras = known_cameras(options)
    options.place, axes = in_axes_of(out, found, None if cameras is None else cameras.world_from_cam)
    said = write(out, in_frame(final, options.place), options)
    return f"{out}: {said}{left_out}; {told(out, found, axes)}"


def main(arguments: list[str] | None = None, prog: str = "python -m mvsgs_core.export") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    input_arguments(parser)
    parser.add_argument(
        "out", type=Path, help="file.ply, .splat, .spz, .glb, .obj, .json, .txt, or a folder for a COLMAP model"
    )
    parser.add_argument("--fold", action="store_true", help="fold the shape into the scales (.ply)")
    parser.add_argument("--mesh", action="store_true", help="OUT.ply is a mesh, not splats")
    parser.add_argument(
        "--images", type=Path, nargs="?", const=BESIDE, metavar="FOLDER",
        help="copy the keyframes' images into the COLMAP model; default: those beside the map, as "
        "mapper.save_images=true leaves them",
    )  # fmt: skip
    parser.add_argument("--observations", action="store_true", help="which points each image shows (COLMAP model)")
    parser.add_argument("--trajectory", type=Path, help="poses in place of the keyframes', TUM format")
    parser.add_argument("--every", type=int, default=1, help="of the keyframes or poses, every so many")
    parser.add_argument("--voxel", type=float, default=0.01, help="of the mesh, in median depths")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all lengths")
    parser.add_argument(
        "--frame", choices=("map", "enu", "given"), default="map",
        help="enu: metres east, north and up, where the run had GPS; OUT.origin.json says of which place; given: "
        "that of the poses that came with the frames, as a robot's odometry",
    )  # fmt: skip
    return run(parser, arguments, partial(export, unset=parser.get_default))


if __name__ == "__main__":
    sys.exit(main())
