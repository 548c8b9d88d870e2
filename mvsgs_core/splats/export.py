"""Turns a map.ply into other formats: `python -m mvsgs_core.splats.export MAP.ply OUT`.

OUT decides: gaussians.ply (--fold, for viewers without shapes), .splat, .spz, a mesh (.obj, .glb, or --mesh with .ply),
or a folder for a COLMAP model. Mesh and COLMAP model need the poses: --trajectory, --size and --intrinsics.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvsgs_core.evaluation.trajectory import read_tum
from mvsgs_core.splats.export_colmap import write_colmap
from mvsgs_core.splats.export_mesh import write_mesh
from mvsgs_core.splats.export_ply import read_ply, write_ply
from mvsgs_core.splats.export_splat import write_splat, write_spz
from mvsgs_core.splats.model import Splats
from mvsgs_core.splats.snapshot import Snapshot


def scaled(final: Snapshot, factor: float) -> Snapshot:
    """The same map in another unit."""
    s = final.splats
    bigger = Splats(s.means * factor, s.log_scales + math.log(factor), s.quaternions, s.opacity_logits, s.sh, s.betas)
    poses = final.world_from_cam.copy()
    poses[:, :3, 3] *= factor
    return replace(final, splats=bigger, origin=final.origin * factor, world_from_cam=poses)


def camera_arguments(parser: argparse.ArgumentParser) -> None:
    """--size and --intrinsics, with which poses become cameras."""
    parser.add_argument("--size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), default=(480, 640))
    parser.add_argument(
        "--intrinsics",
        type=float,
        nargs=4,
        metavar=("FX", "FY", "CX", "CY"),
        help="pixels at --size; default: 60 degrees",
    )


def intrinsics_of(options: argparse.Namespace) -> np.ndarray:
    """(4,) of the command line, or 60 degrees horizontally."""
    if options.intrinsics is not None:
        return np.array(options.intrinsics)
    height, width = options.size
    focal = 0.5 * width / math.tan(math.radians(30.0))
    return np.array([focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)])


def export(options: argparse.Namespace) -> str:
    """Does what the command line asks; returns one line that says what was written. Raises ValueError, OSError."""
    final = scaled(read_ply(options.map), options.scale)
    out: Path = options.out
    poses = None
    if options.trajectory is not None:
        stamps, poses = read_tum(options.trajectory)
        poses = poses[:: options.every].copy()
        stamps = stamps[:: options.every]
        poses[:, :3, 3] *= options.scale
    mesh = options.mesh or out.suffix in (".obj", ".glb", ".stl", ".off")
    if mesh or out.suffix == "":
        if poses is None:
            raise ValueError("a mesh and a COLMAP model need poses: --trajectory trajectory.txt")
        size, intrinsics = tuple(options.size), intrinsics_of(options)
        if mesh:
            vertices, triangles = write_mesh(out, final, poses, intrinsics, size, options.voxel)
            return f"{out}: {vertices} vertices, {triangles} triangles"
        names = [f"{stamp:.6f}.png" for stamp in stamps]
        return f"{out}: {len(names)} images, {write_colmap(out, final, names, poses, intrinsics, size)} points"
    if out.suffix == ".ply":
        write_ply(out, final, fold=options.fold)
    elif out.suffix == ".splat":
        write_splat(out, final)
    elif out.suffix == ".spz":
        write_spz(out, final)
    else:
        raise ValueError(f"no format {out.suffix!r}; there are: .ply, .splat, .spz, .obj, .glb, .stl, .off, a folder")
    return f"{out}: {len(final.splats)} splats, {out.stat().st_size} bytes"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m mvsgs_core.splats.export", description=__doc__)
    parser.add_argument("map", type=Path, help="map.ply")
    parser.add_argument("out", type=Path, help="file.ply, .splat, .spz, .obj, .glb, or a folder for a COLMAP model")
    parser.add_argument("--fold", action="store_true", help="fold the shape into the scales (.ply)")
    parser.add_argument("--mesh", action="store_true", help="OUT.ply is a mesh, not splats")
    parser.add_argument("--trajectory", type=Path, help="trajectory.txt of the run, TUM format")
    parser.add_argument("--every", type=int, default=5, help="of the trajectory's poses, every so many")
    parser.add_argument("--voxel", type=float, default=0.01, help="of the mesh, in median depths")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all lengths")
    camera_arguments(parser)
    try:
        print(export(parser.parse_args(arguments)))
    except (ValueError, OSError, ImportError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
