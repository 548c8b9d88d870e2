"""What the networks that see several posed views share."""

from __future__ import annotations

import torch
from torch import Tensor


def projections(cam_from_world: Tensor, cameras: Tensor, scale: float) -> Tensor:
    """(V, 4, 4): K [R | t], K scaled without a half-pixel shift, as the released weights were trained."""
    k = cameras.clone()
    k[:, :2] *= scale
    found = cam_from_world.clone()
    found[:, :3] = k @ cam_from_world[:, :3]
    return found


def check_range(depth_range: tuple[float, float]) -> tuple[float, float]:
    """(near, far) as they are. Raises ValueError for a range without sense."""
    near, far = depth_range
    if not 0 < near < far < float("inf"):
        raise ValueError(f"depth range {depth_range}: it needs 0 < near < far")
    return near, far


def homogeneous_pixels(height: int, width: int, device: torch.device) -> Tensor:
    """(3, H * W) float64, in raster order."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64, device=device),
        torch.arange(width, dtype=torch.float64, device=device),
        indexing="ij",
    )
    return torch.stack([x, y, torch.ones_like(x)]).reshape(3, -1)
