"""RAFT-small as a flow of the tracker (mvsgs_core.tracking.matching.flow), by itself or refined to subpixels.

`flow: mvsgs_core.tracking.matching.raft_flow:RefinedRaftFlow`. RAFT alone solves at 1/8 and interpolates: its matches
are some tenths of a pixel off, which costs accuracy; it is there for motion and blur that Lucas-Kanade does not follow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import torch

from mvsgs_core import weights
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.raft_small import STRIDE, RaftSmall
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import LucasKanade, Matches


@dataclass
class RaftFlow:
    """Dense flow there and back, begun from the guess; the weight falls with the distance from where it came.

    Raises FileNotFoundError where the weights are missing, saying what to fetch from where.
    """

    weights: str | None = None  # file; None: found by the registry
    iterations: int = 8  # of the recurrent update
    guided: bool = True  # the search begins at the guess that the tracker has
    distance_sigma: float = 0.7  # pixels there and back at which the weight has fallen to 0.6
    max_distance: float = 2.0  # pixels there and back
    device: str = "cpu"
    needs_color: bool = True
    calls: int = field(default=0, repr=False)  # pairs of images

    def __post_init__(self) -> None:
        self._file = weights.find("raft_small", self.weights)

    @cached_property
    def _net(self) -> RaftSmall:
        net = RaftSmall()
        checkpoints.load_registered(net, "raft_small", self._file)
        return net.to(self.device)

    def field(self, a: TrackingImage, b: TrackingImage, start: np.ndarray | None, back: bool) -> np.ndarray:
        """Flow (1, 2, H, W) float32 in pixels from a to b; with `back` (2, 2, H, W), the second from b to a.

        start: (2, H / 8, W / 8) flow from a to b to begin with, in pixels of the 1/8 map.
        """
        self.calls += 1
        first = torch.from_numpy(np.stack([_color(a), _color(b)])).permute(0, 3, 1, 2).float().to(self.device)
        second = first.flip(0)
        begin = None
        if start is not None:
            # on the way back the same motion, at nearly the same place: a start, no more
            begin = torch.from_numpy(np.stack([start, -start]).astype(np.float32)).to(self.device)
        if not back:
            first, second, begin = first[:1], second[:1], None if begin is None else begin[:1]
        flow: np.ndarray = self._net(first, second, self.iterations, begin).cpu().numpy()
        return flow

    def start(self, a: TrackingImage, points: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
        """What the search begins with, (2, H / 8, W / 8); None: nothing."""
        if not self.guided:
            return None
        return _coarse_field(points, guess - points, (a.size[0] // STRIDE, a.size[1] // STRIDE))

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        """Points of a (N, 2) in b; a point is lost where the way back leads elsewhere or it leaves the image."""
        height, width = b.size
        there, back = self.field(a, b, self.start(a, points, guess), back=True)
        at = np.asarray(points, dtype=np.float64)
        target = at + _sample(there, at)
        inside = np.all((target >= 0) & (target <= [width - 1, height - 1]), axis=1) & np.isfinite(target).all(axis=1)
        landing = np.where(inside[:, None], target, 0.0)
        distance = np.linalg.norm(landing + _sample(back, landing) - at, axis=1)
        alive = inside & (distance < self.max_distance)
        weight = np.where(alive, np.exp(-0.5 * np.square(np.where(alive, distance, 0.0) / self.distance_sigma)), 0.0)
        return Matches(np.where(alive[:, None], target, np.nan), weight)


@dataclass
class RefinedRaftFlow(RaftFlow):
    """RAFT one way finds the points, Lucas-Kanade at full size refines and verifies them."""

    threads: int = 1  # of the refinement

    @cached_property
    def _refinement(self) -> LucasKanade:
        return LucasKanade(start_level=0, threads=self.threads)

    def match(self, a: TrackingImage, b: TrackingImage, points: np.ndarray, guess: np.ndarray) -> Matches:
        """Points of a (N, 2) in b; a point is lost where Lucas-Kanade does not confirm it."""
        (flow,) = self.field(a, b, self.start(a, points, guess), back=False)
        at = np.asarray(points, dtype=np.float64)
        return self._refinement.match(a, b, points, at + _sample(flow, at))


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


__all__ = ["RaftFlow", "RefinedRaftFlow"]
