"""Turns a map.ply into other formats: `python -m mvsgs_core.export MAP.ply OUT`.

OUT decides: gaussians.ply (--fold, for viewers without shapes), .splat, .spz, a mesh (.glb, .obj, or --mesh with .ply),
or a folder for a COLMAP model, with --images and --observations where they are wanted. Mesh and COLMAP model are made
from the keyframes in the cameras.json beside the map, or from a --trajectory.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

from mvsgs_core.export import keyframe_images
from mvsgs_core.export.colmap import write_colmap
from mvsgs_core.export.input import cameras_of_map, input_arguments, read_map
from mvsgs_core.export.mesh import write_mesh
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.splat import write_splat, write_spz
from mvsgs_core.rasterizer.splats import Splats

MESHES = (".glb", ".obj", ".stl", ".off")


def scaled(final: Snapshot, factor: float) -> Snapshot:
    """The same map in another unit."""
    s = final.splats
    bigger = Splats(s.means * factor, s.log_scales + math.log(factor), s.quaternions, s.opacity_logits, s.sh, s.betas)
    poses = final.world_from_cam.copy()
    poses[:, :3, 3] *= factor
    return replace(final, splats=bigger, origin=final.origin * factor, world_from_cam=poses)


def export(options: argparse.Namespace) -> str:
    """Does what the command line asks; returns one line that says what was written. Raises ValueError, OSError."""
    if not (math.isfinite(options.scale) and options.scale > 0):
        raise ValueError("--scale must be positive")
    out: Path = options.out
    final, left_out = read_map(options)
    final = scaled(final, options.scale)
    if options.mesh or out.suffix in MESHES:
        vertices, triangles = write_mesh(out, final, cameras_of_map(options), options.voxel)
        said = f"{out}: {vertices} vertices, {triangles} triangles"
    elif out.suffix == "":
        images = options.images
        if images is not None and options.trajectory is not None:
            raise ValueError("--images are those of the keyframes, of which a --trajectory knows nothing")
        written = write_colmap(out, final, cameras_of_map(options), images, options.observations)
        said = f"{out}: {written.images} images, {written.points} points, {written.observations} observations"
    elif out.suffix in (".ply", ".splat", ".spz"):
        if out.suffix == ".ply":
            write_ply(out, final, fold=options.fold)
        elif out.suffix == ".splat":
            write_splat(out, final)
        else:
            write_spz(out, final)
        said = f"{out}: {len(final.splats)} splats, {out.stat().st_size} bytes"
    else:
        raise ValueError(f"no format {out.suffix!r}; there are: .ply, .splat, .spz, {', '.join(MESHES)}, a folder")
    return said + (f"; {left_out} splats that are not finite were left out" if left_out else "")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m mvsgs_core.export", description=__doc__)
    input_arguments(parser)
    parser.add_argument("out", type=Path, help="file.ply, .splat, .spz, .glb, .obj, or a folder for a COLMAP model")
    parser.add_argument("--fold", action="store_true", help="fold the shape into the scales (.ply)")
    parser.add_argument("--mesh", action="store_true", help="OUT.ply is a mesh, not splats")
    parser.add_argument("--images", type=Path, nargs="?", const=..., metavar="FOLDER",
                        help="copy the keyframes' images into the COLMAP model; default: those beside the map, as "
                        "mapper.save_images=true leaves them")  # fmt: skip
    parser.add_argument("--observations", action="store_true", help="which points each image shows (COLMAP model)")
    parser.add_argument("--trajectory", type=Path, help="poses in place of the keyframes', TUM format")
    parser.add_argument("--every", type=int, default=1, help="of the keyframes or poses, every so many")
    parser.add_argument("--voxel", type=float, default=0.01, help="of the mesh, in median depths")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on all lengths")
    options = parser.parse_args(arguments)
    if options.images is ...:
        options.images = options.map.with_name(keyframe_images.FOLDER)
    try:
        print(export(options))
    except (ValueError, OSError, ImportError) as error:
        print(f"export: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
