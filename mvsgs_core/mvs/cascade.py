"""Online multi-view stereo: keyframes in, with some keyframes of lag depth maps out."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from mvsgs_core.camera import shrunk
from mvsgs_core.inverse_depth import enlarge_inverse_depth
from mvsgs_core.keyframe_window import Correction, WindowedStage
from mvsgs_core.mvs.backend import make_backend
from mvsgs_core.mvs.hypotheses import RangeConfig, SearchRange, search_range
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from mvsgs_core.mvs.neighbors import NeighborConfig, select_neighbors
from mvsgs_core.mvs.stereo import StereoConfig, StereoDepth, empty_depth, estimate_depth
from mvsgs_core.pace import Effort, Pace, check_share
from mvsgs_core.setting_ranges import at_least


@dataclass(frozen=True)
class OnlineStereoConfig:
    """What every online stereo needs, whatever finds the depth."""

    area: int = 320 * 240  # pixels of a depth map, aspect kept
    lag: int = 2  # keyframes after the reference that are waited for
    window: int = 8  # keyframes before the reference that may be neighbors
    neighbors: NeighborConfig = field(default_factory=NeighborConfig)  # which of them a reference is matched with
    ranges: RangeConfig = field(default_factory=RangeConfig)  # of depth, from the tracker's
    device: str = "auto"  # auto (CUDA if there is one), cpu, cuda or cuda:0
    threads: int | None = None  # of the kernels; null: all
    realtime: bool = False  # less effort, see `efforts`, where keyframes come faster than their depth
    share: float = 0.75  # of a core's time that stereo may take then
    efforts: tuple[int, ...] | None = None  # those that may be made then, by their place among all; null: all

    def __post_init__(self) -> None:
        at_least(self, area=1, lag=0, window=0)
        check_share(self.share)


@dataclass(frozen=True)
class CascadeConfig(StereoConfig, OnlineStereoConfig):
    """Online stereo by the plane sweep."""

    # Whatever a GPU takes over of a keyframe, PyTorch's paths go row by row, in hundreds of thousands of short steps:
    # C++ on two cores needs a tenth of a second.
    device: str = "cpu"  # cpu (C++), cuda or cuda:0 (PyTorch), torch (PyTorch on the CPU), auto (CUDA if there is one)

    def __post_init__(self) -> None:
        StereoConfig.__post_init__(self)
        OnlineStereoConfig.__post_init__(self)


@dataclass(frozen=True)
class CascadeDepth:
    """One keyframe's stereo depth and where it came from."""

    view: StereoKeyframe
    result: StereoDepth
    neighbors: tuple[int, ...]  # indices of the keyframes that it was matched with
    search: SearchRange | None
    problem: str = ""  # why there is no depth; empty if there is
    effort: int = 0  # of the stereo's `efforts`


FULL = Effort("full", 1.0)
NO_STEREO = Effort("the tracker's depth in the place of stereo", 0.01, telling=False)
MASK_MARGIN = 2  # pixels beside a masked one without depth: the matching window's radius, which would show its rim
DOUBTFUL = 0.09  # confidence of the tracker's depth: in fusion, less than any that speaks against another map


class OnlineStereo(WindowedStage[StereoKeyframe, CascadeDepth]):
    """Depth of each keyframe."""

    scales: tuple[int, ...] = (1,)  # sizes of the gray images that a keyframe keeps, as divisors of its own
    efforts: tuple[Effort, ...] = (FULL, NO_STEREO)  # best first

    def __init__(self, config: OnlineStereoConfig) -> None:
        super().__init__(config.window, config.lag)
        self.config = config
        self.pace = Pace(self.efforts, config.share, only=config.efforts if config.realtime else (0,))
        self._previous: tuple[StereoKeyframe, SearchRange] | None = None  # the newest one that got a range

    def prepare(self, index: int, image: np.ndarray, **given: Any) -> StereoKeyframe:
        """A keyframe for `add`, at this stereo's sizes; `given`: all else that `prepare_keyframe` takes."""
        return prepare_keyframe(index, image, area=self.config.area, scales=self.scales, **given)

    def forget(self) -> None:
        super().forget()
        self._previous = None

    def move(self, poses: dict[int, Correction]) -> None:
        """Corrects the range that is remembered, too."""
        super().move(poses)
        if self._previous is not None and self._previous[0].index in poses:
            before, search = self._previous
            now = before.moved(*poses[before.index])
            factor = now.scale / before.scale
            self._previous = now, replace(search, low=search.low / factor, high=search.high / factor)

    def _result(self, reference: StereoKeyframe, others: list[StereoKeyframe]) -> CascadeDepth:
        previous = None
        if self._previous is not None:
            last, previous = self._previous
            if (last.segment, last.size) != (reference.segment, reference.size):
                self._previous = previous = None
        search = search_range(reference, others, previous, self.config.ranges)
        if search is None:
            return CascadeDepth(reference, empty_depth(reference.size), (), None, "no depth range is known")
        chosen = select_neighbors(reference, others, search.typical(), self.config.neighbors)
        if not chosen:
            return CascadeDepth(reference, empty_depth(reference.size), (), search, "no neighbor with a baseline")
        self._previous = reference, search
        views = [n.view for n in chosen]
        with self.pace.spend() as effort:
            if self.pace.efforts[effort] is NO_STEREO:
                result, views = coarse_depth(reference), []
            else:
                result = self._estimate(reference, views, search, effort)
        if reference.mask is not None:
            result = masked(result, shrunk(reference.mask, MASK_MARGIN))
        return CascadeDepth(reference, result, tuple(v.index for v in views), search, effort=effort)

    @abstractmethod
    def _estimate(
        self, reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange, effort: int
    ) -> StereoDepth:
        """Where depth comes from: at least one neighbor, all of the reference's size."""


class Cascade(OnlineStereo):
    """By the plane sweep."""

    efforts = (
        FULL,
        Effort("no choice of surfaces at depth edges", 0.25),
        Effort("half the size, no choice of surfaces at depth edges", 0.06),
        NO_STEREO,
    )

    def __init__(self, config: CascadeConfig | None = None) -> None:
        stereo = config or CascadeConfig()
        super().__init__(stereo)
        quick = replace(stereo, depth_edges=None)
        small = replace(quick, stages=tuple(replace(stage, scale=2 * stage.scale) for stage in stereo.stages))
        self._ways = (stereo, quick, small) if stereo.realtime else (stereo,)  # of the efforts that are stereo
        self.scales = tuple(sorted({stage.scale for way in self._ways for stage in way.stages}))
        self._backend = make_backend(stereo.device, stereo.threads)

    def _estimate(
        self, reference: StereoKeyframe, neighbors: list[StereoKeyframe], search: SearchRange, effort: int
    ) -> StereoDepth:
        way = self._ways[effort]
        return enlarged(estimate_depth(reference, neighbors, search, way, self._backend), reference.size)


def coarse_depth(reference: StereoKeyframe) -> StereoDepth:
    """The tracker's depth at the reference's size, with a confidence that lets it fill holes of the map alone."""
    depth, confidence = enlarge_inverse_depth(reference.inverse_depth, reference.weight, reference.size)
    return StereoDepth(depth, confidence * np.float32(DOUBTFUL), None)


def masked(found: StereoDepth, mask: np.ndarray) -> StereoDepth:
    """Without depth where the mask (H, W) bool is False."""
    depth, confidence = (np.where(mask, values, np.float32(0)) for values in (found.depth, found.confidence))
    return replace(found, depth=depth, confidence=confidence)


def enlarged(found: StereoDepth, size: tuple[int, int]) -> StereoDepth:
    """Depth at that size (height, width), none of it a mean over a depth edge."""
    if found.depth.shape == size:
        return found
    depth, confidence = (
        cv2.resize(values, size[::-1], interpolation=cv2.INTER_NEAREST) for values in (found.depth, found.confidence)
    )
    return StereoDepth(np.asarray(depth), np.asarray(confidence), None, found.counts)
