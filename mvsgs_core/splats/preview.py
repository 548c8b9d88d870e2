"""The map for a viewer while it grows: a render of the newest keyframe and a capped number of splats."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core.splats.mapper import OnlineMapper
from mvsgs_core.splats.reference import rotation_matrices
from mvsgs_core.splats.spherical_harmonics import C0

CHUNK = 16384  # splats whose covariances are made at once: on the way they take several times their size


def preview_arrays(mapper: OnlineMapper, limit: int) -> dict[str, np.ndarray]:
    """`render` (H, W, 3) uint8 and, for at most `limit` splats spread over the map, relative to its origin in world
    units: `means` (N, 3), `covariances` (N, 3, 3), `colors` (N, 3) uint8, `opacities` (N,)."""
    render = mapper.render(mapper.views[-1]).color
    final = mapper.state.detached()
    stride = max(1, -(-len(final) // limit))
    unit = mapper.unit or 1.0
    shapes = zip(final.quaternions[::stride].split(CHUNK), final.log_scales[::stride].split(CHUNK))
    return {
        "render": _bytes(render),
        "means": (final.means[::stride] * unit).cpu().numpy(),
        "covariances": torch.cat([_covariances(q, s, unit) for q, s in shapes]).cpu().numpy(),
        "colors": _bytes(0.5 + C0 * final.sh[::stride, 0]),
        "opacities": torch.sigmoid(final.opacity_logits[::stride]).cpu().numpy(),
    }


def _covariances(quaternions: torch.Tensor, log_scales: torch.Tensor, unit: float) -> torch.Tensor:
    """(N, 3, 3) in world units, of quaternions (N, 4) and log scales (N, 3)."""
    axes = rotation_matrices(quaternions) * (log_scales.exp() * unit)[:, None, :]
    return axes @ axes.transpose(1, 2)


def _bytes(color: torch.Tensor) -> np.ndarray:
    return np.asarray((color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy())
