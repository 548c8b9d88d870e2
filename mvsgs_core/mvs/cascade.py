"""Online multi-view stereo: keyframes in, with two keyframes of lag depth maps out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.mvs.backend import make_backend
from mvsgs_core.mvs.hypotheses import RangeConfig, SearchRange, search_range
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from mvsgs_core.mvs.neighbors import NeighborConfig, select_neighbors
from mvsgs_core.mvs.stereo import StereoConfig, StereoDepth, empty_depth, estimate_depth


@dataclass(frozen=True)
class CascadeConfig:
    """Online stereo."""

    area: int = 320 * 240  # pixels of a depth map, aspect kept
    lag: int = 2  # keyframes after the reference that are waited for
    window: int = 8  # keyframes before the reference that may be neighbors
    device: str = "cpu"  # "cpu" (C++), "auto", "torch", "cuda": see make_backend
    threads: int | None = None  # of the C++ kernels; None: all
    neighbors: NeighborConfig = field(default_factory=NeighborConfig)
    ranges: RangeConfig = field(default_factory=RangeConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)


@dataclass(frozen=True)
class CascadeDepth:
    """One keyframe's stereo depth and where it came from."""

    view: StereoKeyframe
    result: StereoDepth
    neighbors: tuple[int, ...]  # indices of the keyframes that it was matched with
    search: SearchRange | None
    problem: str = ""  # why there is no depth; empty if there is


class Cascade:
    """Feeds on keyframes in stream order; `add` and `flush` yield each keyframe's depth exactly once, in order."""

    def __init__(self, config: CascadeConfig | None = None) -> None:
        self.config = config or CascadeConfig()
        self._backend = make_backend(self.config.device, self.config.threads)
        self._views: list[StereoKeyframe] = []  # a window of the stream, oldest first
        self._waiting: list[int] = []  # indices without depth yet, oldest first
        self._previous_range: SearchRange | None = None

    def prepare(
        self,
        index: int,
        image: np.ndarray,
        intrinsics: np.ndarray,
        world_from_cam: np.ndarray,
        inverse_depth: np.ndarray,
        weight: np.ndarray,
        scale: float,
        segment: int,
    ) -> StereoKeyframe:
        """A view for `add`: image (H, W, 3) uint8 with intrinsics (4,), the tracker's grid (h, w) and its weights."""
        return prepare_keyframe(
            index,
            image,
            intrinsics,
            world_from_cam,
            area=self.config.area,
            scales=tuple(sorted({s.scale for s in self.config.stereo.stages})),
            inverse_depth=inverse_depth,
            weight=weight,
            scale=scale,
            segment=segment,
        )

    def add(self, view: StereoKeyframe, wanted: bool = True) -> Iterator[CascadeDepth]:
        """Depth of the keyframe `lag` before this one; of all that wait if this one starts a new segment or size.

        wanted: whether this one is to get depth too; else it is a neighbor of others only.
        """
        if self._views and (view.segment != self._views[-1].segment or view.size != self._views[-1].size):
            yield from self.flush()
            self._views.clear()
            self._previous_range = None
        self._views.append(view)
        if wanted:
            self._waiting.append(view.index)
        while len(self._waiting) > self.config.lag:
            yield self._next()
        keep = self.config.window + self.config.lag + 1
        del self._views[: max(0, len(self._views) - keep)]

    def flush(self) -> Iterator[CascadeDepth]:
        """Depth of the keyframes that still wait, with the neighbors that are there."""
        while self._waiting:
            yield self._next()

    def move(self, poses: dict[int, tuple[np.ndarray, float]]) -> None:
        """Corrected poses (world_from_cam (4, 4), scale) by keyframe index, for what is still in the window."""
        self._views = [v.moved(*poses[v.index]) if v.index in poses else v for v in self._views]

    def _next(self) -> CascadeDepth:
        index = self._waiting.pop(0)
        reference = next(v for v in self._views if v.index == index)
        others = [v for v in self._views if v.index != index]
        config = self.config
        search = search_range(reference, others, self._previous_range, config.ranges)
        if search is None:
            return CascadeDepth(reference, empty_depth(reference.size), (), None, "no depth range is known")
        chosen = select_neighbors(reference, others, search.typical(), config.neighbors)
        if not chosen:
            return CascadeDepth(reference, empty_depth(reference.size), (), search, "no neighbor with a baseline")
        self._previous_range = search
        views = [n.view for n in chosen]
        result = self._estimate(reference, views, search)
        return CascadeDepth(reference, result, tuple(v.index for v in views), search)

    def _estimate(self, reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange) -> StereoDepth:
        """The source of depth: a subclass puts a network here and keeps views, neighbors and ranges."""
        return estimate_depth(reference, neighbors, search, self.config.stereo, self._backend)
