"""Correlation of feature maps, looked up around a flow (RAFT, section 3.2; DROID-SLAM): all pairs, or on the fly.

Both give the same (E, levels * (2r+1)^2, h, w): channel = 49 * level + 7 * (dx + 3) + (dy + 3) for r = 3,
the x offset being the slow one.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def _offsets(radius: int, like: Tensor) -> Tensor:
    """((2r+1)^2, 2) offsets (dx, dy), dx slow."""
    d = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    return torch.stack(torch.meshgrid(d, d, indexing="ij"), dim=-1).reshape(-1, 2)


def _sample(maps: Tensor, xy: Tensor) -> Tensor:
    """Bilinear values of maps (N, C, h, w) at pixels xy (N, a, b, 2), 0 outside."""
    h, w = maps.shape[-2:]
    # In units of pixels times 2/(size-1): a one-pixel axis has no extent to divide by. No tensor of the two factors is
    # made: a GPU would wait for each.
    x, y = (xy[..., axis] * (2.0 / max(size - 1, 1)) - 1.0 for axis, size in enumerate((w, h)))
    return F.grid_sample(maps, torch.stack([x, y], dim=-1), align_corners=True, padding_mode="zeros")


class CorrelationVolume:
    """All pairs: memory h^2 w^2 per edge, each lookup cheap. Features (E, C, h, w) of both ends of E edges."""

    def __init__(self, source: Tensor, target: Tensor, levels: int = 4, radius: int = 3, scale: float = 1 / 16) -> None:
        edges, _, h, w = source.shape
        # Scaled before: in half precision the product of unscaled features may be beyond what it can hold.
        half = scale**0.5
        volume = torch.einsum("ecp,ecq->epq", half * source.flatten(2), half * target.flatten(2))
        volume = volume.reshape(edges * h * w, 1, *target.shape[2:])
        self.radius, self.shape = radius, (edges, h, w)
        self.pyramid = [volume]
        for _ in range(levels - 1):
            self.pyramid.append(F.avg_pool2d(self.pyramid[-1], 2))

    def __call__(self, coords: Tensor) -> Tensor:
        """coords (E, h, w, 2): (x, y) in pixels of the target's map."""
        edges, h, w = self.shape
        offsets = _offsets(self.radius, coords)
        found = []
        for level, volume in enumerate(self.pyramid):
            xy = coords.reshape(-1, 1, 1, 2) / 2**level + offsets[None, None]
            values = _sample(volume, xy)
            found.append(values.reshape(edges, h, w, -1))
        return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


class OnTheFlyCorrelation:
    """The same values without the volume: memory h w per edge, for graphs too large for all pairs.

    Pooling the volume over the target's axes is pooling the target's features, as the product is linear.
    """

    def __init__(self, source: Tensor, target: Tensor, levels: int = 4, radius: int = 3, scale: float = 1 / 16) -> None:
        self.radius, self.scale, self.source = radius, scale, source
        self.pyramid = [target]
        for _ in range(levels - 1):
            self.pyramid.append(F.avg_pool2d(self.pyramid[-1], 2))

    def __call__(self, coords: Tensor) -> Tensor:
        offsets = _offsets(self.radius, coords)
        found = []
        for level, target in enumerate(self.pyramid):
            for offset in offsets:
                values = _sample(target, coords / 2**level + offset)
                found.append((self.source * values).sum(dim=1) * self.scale)
        return torch.stack(found, dim=1)
