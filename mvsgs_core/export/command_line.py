"""What the commands of this folder share: the map.ply and the cameras that they start from, and how they end."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mvsgs_core import camera
from mvsgs_core.export.cameras import Cameras, read_cameras
from mvsgs_core.export.ply import read_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.trajectory_file import read_trajectory

FAILURES = (ValueError, OSError, ImportError, MemoryError)  # that are said to a user, who can mend them


def why(error: BaseException) -> str:
    """One of FAILURES in a line."""
    return f"not enough memory: {error}".removesuffix(": ") if isinstance(error, MemoryError) else str(error)


def run(
    parser: argparse.ArgumentParser, arguments: list[str] | None, command: Callable[[argparse.Namespace], str]
) -> int:
    """Prints what a command says it has written, or in one line why it could not be; returns the exit code."""
    options = parser.parse_args(arguments)
    try:
        print(command(options))
    except FAILURES as error:
        print(f"{parser.prog.replace('.', ' ').split()[-1]}: {why(error)}", file=sys.stderr)
        return 1
    return 0


def map_file(text: str) -> Path:
    """A map.ply, or that in the folder that was named."""
    path = Path(text).expanduser()
    return path / "map.ply" if path.is_dir() else path


def input_arguments(parser: argparse.ArgumentParser) -> None:
    """The map and the camera, for `read_map`, `lens` and `cameras_of_map`."""
    parser.add_argument("map", type=map_file, help="map.ply, or the output folder of a run")
    parser.add_argument(
        "--drop-unsound", action="store_true", help="leave out splats with NaN or Inf, and say how many"
    )
    parser.add_argument(
        "--antialiased", action="store_true",
        help="the map was trained so by a program that leaves no comment of it in the file",
    )  # fmt: skip
    parser.add_argument("--cameras", type=Path, help="default: the cameras.json beside the map")
    parser.add_argument("--size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="default: that of the cameras")
    parser.add_argument(
        "--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"),
        help="pixels at --size; default: those of the cameras",
    )  # fmt: skip


def read_map(options: argparse.Namespace) -> tuple[Snapshot, str]:
    """As `sound_map`, of what a command line asks for."""
    return sound_map(options.map, options.drop_unsound, options.antialiased or None, "--drop-unsound")


def sound_map(file: Path, drop_unsound: bool, antialiased: bool | None, dropping: str) -> tuple[Snapshot, str]:
    """The map, and what is to be said of splats that were left out because a value of theirs is not finite, or nothing.

    antialiased: None: as the file says. dropping: how a user asks for `drop_unsound`. Raises ValueError where there are
    such splats and nobody did, or nothing is left, FileNotFoundError.
    """
    if not file.is_file():
        raise FileNotFoundError(f"{file} is missing: a map is a map.ply, or the output folder of a run")
    final = read_ply(file)
    splats = final.splats
    if not len(splats):
        raise ValueError(f"{file} has no splats, and so nothing to show or to write: give a map that has some")
    sound = torch.ones(len(splats), dtype=torch.bool)
    for value in splats.tensors().values():
        sound &= torch.isfinite(value).reshape(len(splats), -1).all(dim=1)
    sound &= splats.quaternions.norm(dim=1) > 0
    unsound = int((~sound).sum())
    if unsound == len(splats):
        raise ValueError(
            f"none of the {unsound} splats in {file} has values that are all finite: the file is damaged, and nothing "
            "of it is left; make the map again, or give another"
        )
    if unsound and not drop_unsound:
        raise ValueError(
            f"{unsound} of {len(splats)} splats in {file} have values that are not finite: the file is damaged; "
            f"{dropping} leaves them out"
        )
    kept = Splats(**{name: value[sound] for name, value in splats.tensors().items()})
    said = f"; {unsound} splats that are not finite were left out" if unsound else ""
    told = final.antialiased if antialiased is None else antialiased
    return replace(final, splats=kept, anchors=final.anchors[sound.numpy()], antialiased=told), said


def known_cameras(options: argparse.Namespace) -> Cameras | None:
    """Those that were named, or that stand beside the map."""
    beside: Path = options.map.with_name("cameras.json")
    if options.cameras is None and not beside.is_file():
        return None
    cameras = read_cameras(options.cameras or beside)
    return cameras if len(cameras) else None


def _given_size(options: argparse.Namespace) -> tuple[int, int] | None:
    """What --size says. Raises ValueError."""
    if options.size is None:
        return None
    height, width = options.size
    if min(height, width) < 1:
        raise ValueError(f"--size {height} {width}: both must be positive")
    return height, width


def lens(options: argparse.Namespace) -> tuple[np.ndarray, tuple[int, int]]:
    """Intrinsics (4,) and size (height, width) for poses that come without: given, or the newest keyframe's.

    Raises ValueError where neither says them.
    """
    known = known_cameras(options)
    size = _given_size(options)
    if known is not None:
        known_size = (int(known.sizes[-1, 0]), int(known.sizes[-1, 1]))
        size = size or known_size
        if options.intrinsics is None:
            return camera.scale_intrinsics(known.intrinsics[-1], known_size, size), size
    if size is None or options.intrinsics is None:
        raise ValueError(
            f"there is no cameras.json beside {options.map}, so that the camera is not known: give it with --cameras, "
            "or its --intrinsics and --size"
        )
    intrinsics = np.array(options.intrinsics)
    if not (np.isfinite(intrinsics).all() and (intrinsics[:2] > 0).all()):
        raise ValueError("--intrinsics: the focal lengths must be positive")
    return intrinsics, size


def read_path(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and poses (N, 4, 4) of a file as `read_trajectory` reads it. Raises ValueError where it has none."""
    stamps, poses = read_trajectory(file)
    if not len(poses):
        raise ValueError(f"{file} has no poses: a line is `time tx ty tz qx qy qz qw`, as in a run's trajectory.txt")
    return stamps, poses


def cameras_of_map(options: argparse.Namespace) -> Cameras:
    """Every --every-th keyframe of the map, or pose of --trajectory, at --scale. A --size scales each keyframe's own
    intrinsics; --intrinsics are those of all.

    Raises ValueError where the map has no cameras.json and no trajectory was given, and where that has no poses.
    """
    if options.every < 1:
        raise ValueError("--every must be at least 1")
    known = known_cameras(options)
    if options.trajectory is not None:
        stamps, poses = read_path(options.trajectory)
        found = Cameras(
            keyframes=np.arange(len(stamps)), timestamps=stamps, world_from_cam=poses, intrinsics=np.zeros((0, 4)),
            sizes=np.zeros((0, 2)), exposures=np.tile(np.eye(3, 4), (len(stamps), 1, 1)),
        )  # fmt: skip
    elif known is not None:
        found = known
    else:
        raise ValueError(
            f"a mesh and a COLMAP model need cameras, and there is no cameras.json beside {options.map}: give it with "
            "--cameras, or --trajectory, --intrinsics and --size"
        )
    size = _given_size(options)
    if options.trajectory is not None or options.intrinsics is not None:
        intrinsics, size = lens(options)
        found = replace(found, intrinsics=np.tile(intrinsics, (len(found), 1)), sizes=_tiled(size, len(found)))
    elif size is not None:
        scaled = [
            camera.scale_intrinsics(values, (height, width), size)
            for values, (height, width) in zip(found.intrinsics, found.sizes.tolist())
        ]
        found = replace(found, intrinsics=np.array(scaled), sizes=_tiled(size, len(found)))
    chosen = found.chosen(slice(None, None, options.every))
    chosen.world_from_cam[:, :3, 3] *= options.scale
    return chosen


def _tiled(size: tuple[int, int], count: int) -> np.ndarray:
    return np.tile(np.array(size), (count, 1))
