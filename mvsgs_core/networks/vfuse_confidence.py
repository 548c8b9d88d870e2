"""The confidences that V-FUSE (Burgdorfer and Mordohai 2023) can give its fused depth.

The fused depth is an expectation, so it lies between two planes of the search window, at a place p in 0..M-1. With the
window's radius r, smallest r0 and largest r1 in the image, and P(k) the probability of plane k, 0 beside the window:

- `swr`, the published default: (r1 - r) / (r1 - r0). Relative to the image, no probability.
- `single`: P at p, rounded.
- `pns`: P summed over the two planes around p and the next one on each side.
- `pns_swr`: P summed over the two planes around p, times `swr`.
- `pkrn`: 1 - the lesser over the greater of the two planes around p (peak ratio, naive), times 1 - r / r1.
"""

from __future__ import annotations

import torch
from torch import Tensor

MODES = ("swr", "single", "pns", "pns_swr", "pkrn")
_LEAST = 1e-12  # of a divisor


def check_mode(mode: str) -> None:
    """Raises ValueError for a mode that is none of MODES."""
    if mode not in MODES:
        raise ValueError(f"no confidence {mode!r} of V-FUSE: give one of {', '.join(MODES)}")


def confidence_of(mode: str, probability: Tensor, place: Tensor, radius: Tensor) -> Tensor:
    """(H, W) in 0..1 from the planes' probability (M, H, W), the place (H, W) among them and the radius (H, W).

    Raises ValueError for a mode that is none of MODES.
    """
    check_mode(mode)
    if mode == "single":
        return _of_plane(probability, place.round())
    below, above = place.floor(), place.ceil()  # the same plane where the place is one
    if mode == "pns":
        planes = (below - 1, below, above, above + 1)
        return torch.stack([_of_plane(probability, plane) for plane in planes]).sum(dim=0)
    if mode == "swr":
        return _narrowness(radius)
    around = torch.stack([_of_plane(probability, below), _of_plane(probability, above)])
    if mode == "pns_swr":
        return around.sum(dim=0) * _narrowness(radius)
    ratio = around.amin(dim=0) / around.amax(dim=0).clamp(min=_LEAST)
    return (1 - ratio) * (1 - radius / radius.max().clamp(min=_LEAST))


def _of_plane(probability: Tensor, plane: Tensor) -> Tensor:
    """Probability (H, W) of one plane a pixel, given as a float; 0 where there is no such plane."""
    last = len(probability) - 1
    found = probability.gather(0, plane.clamp(0, last).long()[None])[0]
    return torch.where((plane >= 0) & (plane <= last), found, torch.zeros_like(found))


def _narrowness(radius: Tensor) -> Tensor:
    """1 for the narrowest window of the image, 0 for the widest."""
    return 1 - (radius - radius.min()) / (radius.max() - radius.min()).clamp(min=_LEAST)
