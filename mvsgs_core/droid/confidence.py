"""How far a keyframe's inverse depths can be trusted: what its edges say, and whether other keyframes agree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.framing import Framing
from mvsgs_core.droid.geometry import agreeing_neighbors
from mvsgs_core.droid.video import Video

_REACH = 3  # keyframes each way that are asked
_TOLERANCE = 0.05  # of the median depth


class Coarse(NamedTuple):
    inverse_depth: np.ndarray  # (h, w) float32, 0 where nothing is known
    weight: np.ndarray  # (h, w) float32, 0 to 1


def agreement(video: Video, position: int) -> np.ndarray:
    """(h, w) int: how many of the neighbors in time have the same depth, of those that see it."""
    frame = video.frames[position]
    near = [n for n in range(position - _REACH, position + _REACH + 1) if n != position and 0 <= n < len(video)]
    if not near:
        return np.zeros(frame.inverse_depth.shape, np.int64)
    relative = video.relative(np.full(len(near), position), np.array(near))
    count = agreeing_neighbors(
        torch.from_numpy(relative),
        torch.from_numpy(frame.inverse_depth),
        torch.from_numpy(np.stack([video.frames[n].inverse_depth for n in near])),
        torch.from_numpy(video.intrinsics),
        _TOLERANCE * frame.median_depth,
    )
    return count.numpy()


def consistent_fraction(video: Video, position: int) -> float:
    """Fraction of a keyframe's cells whose depth at least one neighbor confirms."""
    return float((agreement(video, position) > 0).mean())


def coarse_map(video: Video, graph: FactorGraph, position: int, framing: Framing) -> Coarse:
    """For the whole view of the image: inverse depth, and as confidence the mean weight of the edges that begin here.

    Cells that fewer than two neighbors confirm are unknown, as in the authors' viewer.
    """
    frame = video.frames[position]
    weights = [e.weight.mean(axis=-1) for e in (*graph.active, *graph.inactive) if e.source == position]
    weight = np.mean(weights, axis=0) if weights else np.zeros_like(frame.inverse_depth)
    known = (agreement(video, position) >= 2) & frame.triangulated
    # depth is sampled before holes are cut, so that no cell is averaged with "unknown"
    inverse_depth, known_there = framing.whole_view(frame.inverse_depth), framing.whole_view(known) > 0.5
    confidence = np.clip(framing.whole_view(weight), 0.0, 1.0)
    known_there &= confidence > 0
    zero = np.float32(0.0)
    return Coarse(np.where(known_there, inverse_depth, zero), np.where(known_there, confidence, zero))


__all__ = ["Coarse", "agreement", "coarse_map", "consistent_fraction"]
