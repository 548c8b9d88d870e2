"""The keyframes of DROID-SLAM, in order, with poses, inverse depths and what the networks made of their images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvsgs_core import geometry
from mvsgs_core.droid.geometry import frame_distance, reproject

MIN_INVERSE_DEPTH = 1e-3  # what bundle adjustment keeps inverse depths above
_PAIRS = 256  # at a time, so that a long video's distances need little memory


@dataclass
class VideoFrame:
    """A keyframe, or a frame between keyframes whose pose is sought. M = h * w cells."""

    index: int  # of the stream
    timestamp: float  # seconds
    cam_from_world: np.ndarray  # (4, 4) float64
    inverse_depth: np.ndarray  # (h, w) float64
    features: Tensor  # (128, h, w)
    hidden: Tensor | None = None  # (128, h, w) of a new edge; None: no edge begins here
    context: Tensor | None = None  # (128, h, w)
    damping: np.ndarray | None = None  # (h, w) of the inverse depth, from the last update; None: none yet

    @property
    def triangulated(self) -> np.ndarray:
        """(h, w) bool: not driven to the least inverse depth."""
        return self.inverse_depth > 1.01 * MIN_INVERSE_DEPTH

    @property
    def median_depth(self) -> float:
        return float(1.0 / np.median(self.inverse_depth))


class Video:
    """Positions in `frames` are what edges name; they move when a keyframe is removed."""

    def __init__(self, intrinsics: np.ndarray) -> None:
        self.intrinsics = np.asarray(intrinsics, dtype=np.float64)  # (4,) in cells
        self._frames: list[VideoFrame] = []
        self._keyframes: dict[int, VideoFrame] = {}  # the same, by index

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def frames(self) -> Sequence[VideoFrame]:
        return self._frames

    @property
    def keyframes(self) -> Mapping[int, VideoFrame]:
        """By index of the stream."""
        return self._keyframes

    def append(self, frame: VideoFrame) -> None:
        self._frames.append(frame)
        self._keyframes[frame.index] = frame

    def remove(self, position: int) -> None:
        del self._keyframes[self._frames.pop(position).index]

    def world_from_cam(self, index: int) -> np.ndarray:
        return geometry.inverse(self.keyframes[index].cam_from_world)

    def relative(self, source: np.ndarray, to: np.ndarray) -> np.ndarray:
        """(E, 4, 4) to_from_source of pairs of positions."""
        poses = np.stack([frame.cam_from_world for frame in self.frames])
        return np.asarray(poses[to] @ geometry.inverse(poses)[source])

    def reproject(self, source: np.ndarray, to: np.ndarray) -> np.ndarray:
        """(E, h, w, 2) coordinates of the cells of `source` in `to`."""
        depths = torch.from_numpy(np.stack([self.frames[n].inverse_depth for n in source]))
        relative = torch.from_numpy(self.relative(source, to))
        coords, _ = reproject(relative, depths, torch.from_numpy(self.intrinsics))
        return coords.numpy()

    def distances(self, a: np.ndarray, b: np.ndarray, beta: float) -> np.ndarray:
        """(E,) distances of pairs of positions, mean of both directions, cells."""
        found = np.empty(len(a))
        for start in range(0, len(a), _PAIRS):
            part = slice(start, start + _PAIRS)
            both = [self._distance(i[part], j[part], beta) for i, j in ((a, b), (b, a))]
            found[part] = 0.5 * (both[0] + both[1])
        return found

    def _distance(self, source: np.ndarray, to: np.ndarray, beta: float) -> np.ndarray:
        depths = torch.from_numpy(np.stack([self.frames[n].inverse_depth for n in source]).astype(np.float32))
        relative = torch.from_numpy(self.relative(source, to).astype(np.float32))
        intrinsics = torch.from_numpy(self.intrinsics.astype(np.float32))
        return np.nan_to_num(frame_distance(relative, depths, intrinsics, beta).numpy(), nan=1000.0)

    def normalize(self) -> float:
        """Scales the map so that the mean inverse depth is 1. Returns the factor on depths and positions."""
        factor = float(np.mean([frame.inverse_depth.mean() for frame in self.frames]))
        for frame in self.frames:
            frame.inverse_depth = frame.inverse_depth / factor
            frame.cam_from_world = geometry.scaled(frame.cam_from_world, factor)
        return factor

    def around(self, indices: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the keyframes before and after frames of the stream; the last one twice beyond the end."""
        own = np.array([frame.index for frame in self.frames])
        before = np.maximum(np.searchsorted(own, np.asarray(indices), side="right") - 1, 0)
        return before, np.minimum(before + 1, len(own) - 1)


__all__ = ["MIN_INVERSE_DEPTH", "Video", "VideoFrame"]
