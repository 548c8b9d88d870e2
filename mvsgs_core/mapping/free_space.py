"""Splats that hang before a surface which a keyframe knows: made of doubtful depth, or far away, for a few views.

A camera that drives on sees through the place where the sky, or a wall at a wrong depth, was put. Such splats cover
what is behind them, so that none are made there, and the views that would fade them out are few.
"""

from __future__ import annotations

from torch import Tensor

SHARE = 0.3  # of what an image shows of a splat, that must lie on known depth: of less, the rest may be right


def in_free_space(light: Tensor, z: Tensor, nearer: float) -> Tensor:
    """(N,) bool: much of what is seen of a splat lies before a known surface.

    light (N, 3): the splat's blending weights, summed over the image; over the pixels of known depth; and there times
    the inverse depth. z (N,): depth of its center; nearer: fraction of the known depth, in the mean, below which it is.
    """
    everything, known, inverse = light.unbind(dim=1)
    return (z > 0) & (everything > 0) & (known >= SHARE * everything) & (z * inverse < nearer * known)
