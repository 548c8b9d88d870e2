"""Compact files for web viewers: .splat (32 bytes a splat), .spz (compressed, by open3d). Both know only Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mvsgs_core.export.ply import folded, relative_origin
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.turning import RUB_FROM_RDF, turned
from mvsgs_core.open3d_loader import open3d
from mvsgs_core.rasterizer.spherical_harmonics import C0

SPZ_STEP = 1.0 / 4096.0  # .spz keeps positions as multiples of this
SPZ_REACH = 2048.0  # in 24 bits
SPZ_4, SPZ_FLAGS, SPZ_ANTIALIASED = b"NGSP\x04\0\0\0", 14, 1  # magic and version, place of the flags, one of them


def write_splat(path: Path, final: Snapshot) -> None:
    """position 3 float32, standard deviation 3 float32, color and opacity 4 uint8, rotation 4 uint8; no directions.

    Axes as in map.ply: the format names none, and those who convert between the two change none. The largest and most
    opaque splats come first: viewers show a file while it loads.
    """
    splats = folded(final.splats, final.kernel)
    means = splats.means.numpy() + (final.origin - relative_origin(final)).astype(np.float64)
    opacity = torch.sigmoid(splats.opacity_logits)
    rows = np.zeros(
        len(splats), dtype=[("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
    )
    rows["mean"] = means
    rows["scale"] = splats.log_scales.exp().numpy()
    rows["color"][:, :3] = _bytes((0.5 + C0 * splats.sh[:, 0]).numpy() * 255.0)
    rows["color"][:, 3] = _bytes(opacity.numpy() * 255.0)
    rows["rotation"] = _bytes(torch.nn.functional.normalize(splats.quaternions, dim=1).numpy() * 128.0 + 128.0)
    weight = splats.log_scales.sum(dim=1) + opacity.log()
    order = torch.argsort(weight, descending=True, stable=True).numpy()
    path.write_bytes(rows[order].tobytes())


def write_spz(path: Path, final: Snapshot) -> None:
    """Through open3d. The format's axes are x right, y up, z back ("RUB"): everything is turned by 180 degrees about x,
    view-dependent colors too.

    Raises ValueError where the format's fixed steps of 1/4096 unit would blur the map or its 24 bits do not reach as
    far, OSError where the file cannot be written.
    """
    splats = turned(folded(final.splats, final.kernel), RUB_FROM_RDF)
    means = splats.means.numpy() + RUB_FROM_RDF @ (final.origin - relative_origin(final))
    typical = float(splats.log_scales.max(dim=1).values.median().exp()) if len(splats) else 1.0
    if typical < 2.0 * SPZ_STEP:
        raise ValueError(
            f".spz rounds positions to 1/4096 unit, and half of the splats are smaller than {typical:.2g}: "
            "write .ply or .splat, or enlarge the map (--scale)"
        )
    far = int((np.abs(means) >= SPZ_REACH).any(axis=1).sum())
    if far:
        raise ValueError(
            f".spz holds positions within {SPZ_REACH:g} units, and {far} splats are farther away: "
            "write .ply or .splat, or make the map smaller (--scale)"
        )
    o3d = open3d()

    def tensor(values: np.ndarray) -> object:
        return o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))

    cloud = o3d.t.geometry.PointCloud(tensor(means))
    cloud.point["f_dc"] = tensor(splats.sh[:, 0].numpy())
    cloud.point["opacity"] = tensor(splats.opacity_logits[:, None].numpy())
    cloud.point["scale"] = tensor(splats.log_scales.exp().numpy())
    cloud.point["rot"] = tensor(torch.nn.functional.normalize(splats.quaternions, dim=1).numpy())
    if splats.sh.shape[1] > 1:
        cloud.point["f_rest"] = tensor(splats.sh[:, 1:].numpy())
    if not o3d.t.io.write_point_cloud(str(path), cloud):
        raise OSError(f"open3d could not write {path}")
    if final.antialiased:
        _flag_antialiased(path)


def _flag_antialiased(path: Path) -> None:
    """Sets that flag in the header of a .spz of version 4, which open3d leaves 0."""
    with path.open("r+b") as file:
        head = bytearray(file.read(SPZ_FLAGS + 1))
        if head[:8] != SPZ_4 or len(head) <= SPZ_FLAGS:
            raise OSError(f"{path}: open3d wrote no .spz of version 4, in which a map is said to be antialiased")
        file.seek(SPZ_FLAGS)
        file.write(bytes([head[SPZ_FLAGS] | SPZ_ANTIALIASED]))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.round(values), 0, 255).astype(np.uint8))
