"""Compact files for web viewers: .splat (32 bytes a splat), .spz (compressed). Both know only Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from mvsgs_core.atomic_file import replacing
from mvsgs_core.export import spz
from mvsgs_core.export.ply import folded, relative_origin
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.turning import RUB_FROM_RDF, turned
from mvsgs_core.rasterizer.interface import as_bytes
from mvsgs_core.rasterizer.spherical_harmonics import to_rgb


def write_splat(path: Path, final: Snapshot) -> None:
    """Replaces `path` in one step: position 3 float32, standard deviation 3 float32, color and opacity 4 uint8,
    rotation 4 uint8; no directions.

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
    rows["color"][:, :3] = as_bytes(to_rgb(splats.sh[:, 0]))
    rows["color"][:, 3] = as_bytes(opacity)
    rotation = torch.nn.functional.normalize(splats.quaternions, dim=1)
    rows["rotation"] = np.clip(np.round(rotation.numpy() * 128.0 + 128.0), 0, 255)
    weight = splats.log_scales.sum(dim=1) + opacity.log()
    order = torch.argsort(weight, descending=True, stable=True).numpy()
    with replacing(path, sync=False) as aside:
        aside.write_bytes(rows[order].tobytes())


def write_spz(path: Path, final: Snapshot) -> None:
    """Replaces `path` in one step. The format's axes are x right, y up, z back ("RUB"): everything is turned by 180
    degrees about x, view-dependent colors too.

    Raises ValueError where the format's fixed steps of 1/4096 unit would blur the map or its 24 bits do not reach as
    far, OSError where the file cannot be written.
    """
    splats = turned(folded(final.splats, final.kernel), RUB_FROM_RDF)
    means = splats.means.numpy() + RUB_FROM_RDF @ (final.origin - spz_origin(final))
    typical = float(splats.log_scales.max(dim=1).values.median().exp()) if len(splats) else 1.0
    if typical < 2.0 * spz.STEP:
        raise ValueError(
            f".spz rounds positions to 1/4096 unit, and half of the splats are smaller than {typical:.2g}: "
            "write .ply or .splat, or enlarge the map (--scale)"
        )
    far = int((np.abs(means) >= spz.REACH).any(axis=1).sum())
    if far:
        raise ValueError(
            f".spz holds positions within {spz.REACH:g} units, and {far} splats are farther away: "
            "write .ply or .splat, or make the map smaller (--scale)"
        )
    opacity, harmonics = torch.sigmoid(splats.opacity_logits).numpy(), splats.sh.numpy()
    scales, quaternions = splats.log_scales.numpy(), splats.quaternions.numpy()
    data = spz.packed(means, scales, quaternions, opacity, harmonics, final.antialiased)
    with replacing(path, sync=False) as aside:
        aside.write_bytes(data)


def spz_origin(final: Snapshot) -> np.ndarray:
    """(3,) that positions in an .spz are relative to, in the axes of the map: that of map.ply, or the map's own where
    the format does not reach as far as world coordinates."""
    relative = relative_origin(final)
    world = np.abs(final.splats.means.numpy() + final.origin).max(initial=0.0)
    return relative if relative.any() or world < spz.REACH else final.origin


WRITERS = {".splat": write_splat, ".spz": write_spz}  # by suffix
