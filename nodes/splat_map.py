"""A map as a message, and back."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch

from msgs import SplatMap
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.splats import Splats


def splat_map(final: Snapshot, refined: bool) -> SplatMap:
    """The message of a map."""
    arrays = {name: value.numpy() for name, value in final.splats.tensors().items()}
    return SplatMap(
        refined=refined, iterations=final.iterations, kernel=final.kernel, origin=final.origin, **arrays,
        anchors=final.anchors, keyframes=final.keyframes, world_from_cam=final.world_from_cam, scale=final.scale,
        exposures=final.exposures, vignetting=final.vignetting, antialiased=final.antialiased,
        background=final.background,
    )  # fmt: skip


def snapshot_of(message: SplatMap) -> Snapshot:
    """Copies: what is kept of a message would keep all of it."""
    arrays = {name: value.copy() for name, value in vars(message).items() if isinstance(value, np.ndarray)}
    splats = Splats(**{f.name: torch.from_numpy(arrays.pop(f.name)) for f in fields(Splats)})
    return Snapshot(
        splats, kernel=message.kernel, iterations=message.iterations, antialiased=message.antialiased, **arrays
    )
