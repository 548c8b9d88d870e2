"""What of a map is meant by a click, how far apart two such places are, and which splats lie in a box."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from mvsgs_core.export.keyframe_render import near_plane
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.splats import Splats

_PIXELS_A_RADIAN = 500.0  # of the small picture that is rendered along a ray
_SIDE = 5  # its pixels
_OUTSIDE = 0.5  # percent of the splats that may lie beyond each side of a box of all


def hit(final: Snapshot, start: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Where a ray from `start` (3,) first meets the map, both relative to its origin; None where it meets nothing.

    That is where a camera that looks along the ray sees the map, if it is more than half opaque there.
    """
    length = float(np.linalg.norm(direction))
    if not length > 0 or not len(final.splats):
        return None
    ahead = np.asarray(direction, dtype=np.float64) / length
    side = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    side /= np.linalg.norm(side)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([side, np.cross(ahead, side), ahead], axis=1)
    pose[:3, 3] = start + final.origin
    middle = (_SIDE - 1) / 2
    intrinsics = np.array([_PIXELS_A_RADIAN, _PIXELS_A_RADIAN, middle, middle])
    render = final.render(pose, intrinsics, (_SIDE, _SIDE), near=near_plane(final, pose))
    place = int(middle), int(middle)
    if not render.opacity[place] > 0.5:
        return None
    return np.asarray(start + float(render.depth[place]) * ahead)


@dataclass
class Ruler:
    """Two places and their distance; a distance that is known makes the map's unit known."""

    points: list[np.ndarray] = field(default_factory=list)  # (3,) each, none to two
    factor: float = 1.0  # true units in one of the map

    def add(self, point: np.ndarray) -> None:
        """A third place begins anew."""
        self.points = [*self.points, point] if len(self.points) < 2 else [point]

    @property
    def distance(self) -> float | None:
        """In true units."""
        if len(self.points) < 2:
            return None
        return self.factor * float(np.linalg.norm(self.points[1] - self.points[0]))

    def calibrate(self, length: float) -> None:
        """What is measured is so long. Raises ValueError where nothing is, or no length could be."""
        measured = self.distance
        if not measured:
            raise ValueError("measure a distance first: two places that are not the same")
        if not (np.isfinite(length) and length > 0):
            raise ValueError(f"{length:g} is no length")
        self.factor *= length / measured


@dataclass(frozen=True)
class Box:
    """A box in which a map is kept, its sides along `axes`."""

    axes: np.ndarray  # (3, 3) unit vectors, one a row
    low: np.ndarray  # (3,) where the box of nearly all splats begins and ends along each
    high: np.ndarray

    @staticmethod
    def around(means: np.ndarray, axes: np.ndarray) -> Box:
        """Of nearly all splats (N, 3), N >= 1."""
        low, high = np.percentile(means @ axes.T, (_OUTSIDE, 100.0 - _OUTSIDE), axis=0)
        return Box(axes, low, high)

    def inside(self, points: np.ndarray, percent: np.ndarray) -> np.ndarray:
        """(N,) bool of points (N, 3): within `percent` (3, 2) of the extent along each axis, where 0 and 100 bound
        nothing."""
        bounds = self.low[:, None] + percent / 100.0 * (self.high - self.low)[:, None]
        begin = np.where(percent[:, 0] <= 0, -np.inf, bounds[:, 0])
        end = np.where(percent[:, 1] >= 100, np.inf, bounds[:, 1])
        along = points @ self.axes.T
        return np.asarray(((along >= begin) & (along <= end)).all(axis=1))


def kept(final: Snapshot, chosen: np.ndarray) -> Snapshot:
    """The map of the chosen splats (N,) bool alone."""
    which = torch.from_numpy(chosen)
    splats = Splats(**{name: value[which] for name, value in final.splats.tensors().items()})
    return replace(final, splats=splats, anchors=final.anchors[chosen])


__all__ = ["Box", "Ruler", "hit", "kept"]
