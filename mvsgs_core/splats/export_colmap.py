"""A COLMAP text model that offline trainers read: cameras, images, and the splats' centers as points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.splats.snapshot import Snapshot
from mvsgs_core.splats.spherical_harmonics import C0


def write_colmap(
    folder: Path,
    final: Snapshot,
    names: list[str],
    world_from_cam: np.ndarray,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    min_opacity: float = 0.1,
) -> int:
    """cameras.txt, images.txt and points3D.txt for images `names` (K) at poses (K, 4, 4); returns the number of points.

    intrinsics: (4,) at `size` (height, width); COLMAP's pixel centers are at 0.5, ours at 0. Points have no tracks.
    Raises ValueError where names and poses differ in number.
    """
    if len(names) != len(world_from_cam):
        raise ValueError(f"{len(names)} image names for {len(world_from_cam)} poses")
    folder.mkdir(parents=True, exist_ok=True)
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    (folder / "cameras.txt").write_text(
        "# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {size[1]} {size[0]} {fx!r} {fy!r} {cx + 0.5!r} {cy + 0.5!r}\n"
    )
    lines = ["# Image list: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[] (none)"]
    for k, (name, pose) in enumerate(zip(names, world_from_cam, strict=True)):
        cam_from_world = geometry.inverse(pose)
        numbers = [*geometry.quaternion_from_rotation(cam_from_world[:3, :3]), *cam_from_world[:3, 3]]
        lines += [f"{k + 1} {' '.join(repr(float(value)) for value in numbers)} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    solid = torch.sigmoid(final.splats.opacity_logits).numpy() >= min_opacity
    means = final.splats.means.numpy()[solid].astype(np.float64) + final.origin
    colors = np.clip((0.5 + C0 * final.splats.sh[:, 0].numpy()[solid]) * 255.0, 0, 255).round().astype(int)
    points = ["# 3D point list: POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] (none)"]
    points += [
        f"{k + 1} {x!r} {y!r} {z!r} {r} {g} {b} 0"
        for k, ((x, y, z), (r, g, b)) in enumerate(zip(means.tolist(), colors.tolist(), strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
    return len(means)
