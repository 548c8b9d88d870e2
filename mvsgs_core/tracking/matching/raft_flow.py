"""RAFT-small as a flow of the tracker (mvsgs_core.tracking.matching.flow): `flow: raft_small`, refined to subpixels.

RAFT solves at 1/8 and interpolates: its matches are some tenths of a pixel off, which costs accuracy; it is there for
motion and blur that Lucas-Kanade does not follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch

from mvsgs_core import weights
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.raft_small import STRIDE, RaftSmall
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import LucasKanade, Matches, RefinedFlow


@dataclass
class RaftFlow:
    """Dense flow, begun from the guess; weights are all 1, also of points that leave the image.

    Raises FileNotFoundError where the weights are missing, saying what to fetch from where.
    """

    weights: str | None = None  # file; None: found by the registry
    iterations: int = 8  # of the recurrent update
    guided: bool = True  # the search begins at the guess that the tracker has
    device: str = "cpu"
    needs_color: bool = True

    def __post_init__(self) -> None:
        self._file = weights.find("raft_small", self.weights)

    @cached_property
    def _net(self) -> RaftSmall:
        net = RaftSmall()
        checkpoints.load_registered(net, "raft_small", self._file)
        return net.to(self.device)

    def field(self, a: TrackingImage, b: TrackingImage, start: np.ndarray | None) -> np.ndarray:
        """Flow (2, H, W) float32 in pixels from a to b.

        start: (2, H / 8, W / 8) flow to begin with, in pixels of the 1/8 map; None: nothing is known.
        """
        images = torch.from_numpy(np.stack([_color(a), _color(b)])).permute(0, 3, 1, 2).float().to(self.device)
        begin = None if start is None else torch.from_numpy(start.astype(np.float32)).to(self.device)[None]
        flow: np.ndarray = self._net(images[:1], images[1:], self.iterations, begin).cpu().numpy()[0]
        return flow

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        grid = a.size[0] // STRIDE, a.size[1] // STRIDE
        start = _coarse_field(points, guess - points, grid) if self.guided else None
        at = np.asarray(points, dtype=np.float64)
        return Matches(at + _sample(self.field(a, b, start), at), np.ones(len(at)))


def refined_raft(
    weights: str | None = None, iterations: int = 8, guided: bool = True, device: str = "cpu", threads: int = 1
) -> RefinedFlow:
    """RAFT is off by tenths of a pixel: refined at full size. threads: of the refinement; the rest as `RaftFlow`."""
    return RefinedFlow(RaftFlow(weights, iterations, guided, device), LucasKanade(start_level=0, threads=threads))


def _color(image: TrackingImage) -> np.ndarray:
    if image.color is None:
        raise ValueError(f"frame {image.index} has no color: RAFT needs it (TrackingImage.of(..., color=True))")
    return image.color


def _sample(flow: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) of a flow (2, H, W) at points, bilinear."""
    # two maps: of one with an empty second one OpenCV 5 reads memory that is not there
    x, y = points.astype(np.float32).T[:, None]
    found = [cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for part in flow]
    return np.stack([np.asarray(part).reshape(-1) for part in found], axis=1).astype(np.float64)


def _coarse_field(points: np.ndarray, moved: np.ndarray, grid: tuple[int, int]) -> np.ndarray | None:
    """The mean motion of the points in each 1/8 cell, the median of all where there are none; None without any."""
    known = np.isfinite(moved).all(axis=1)
    if not known.any():
        return None
    rows, columns = grid
    cell = np.clip((points[known] / STRIDE).astype(int), 0, [columns - 1, rows - 1])
    number = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(number, minlength=rows * columns)
    sums = [np.bincount(number, moved[known, n], minlength=rows * columns) for n in (0, 1)]
    median = np.median(moved[known], axis=0)
    means = [np.where(count > 0, s / np.maximum(count, 1), m) for s, m in zip(sums, median)]
    return np.stack(means).reshape(2, rows, columns) / STRIDE


__all__ = ["RaftFlow", "refined_raft"]
