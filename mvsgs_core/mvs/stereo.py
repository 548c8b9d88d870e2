"""Depth of one reference keyframe from its neighbors: sweep, smooth, narrow the search, repeat at the next size."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from mvsgs_core.mvs.confidence import Evidence, probability_of_inlier
from mvsgs_core.mvs.depth_edges import DepthEdgeConfig, refine_depth_edges
from mvsgs_core.mvs.hypotheses import SearchRange, certainty, fill_uncertain, upsample_surface
from mvsgs_core.mvs.interface import RADII, Backend, MatchingImages, SmoothingConfig, SurfaceEstimate
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.mvs.pruning import PruningConfig, tiles_in_cells
from mvsgs_core.setting_ranges import above, at_least, within
from mvsgs_core.warp import parallax, relative_warp


@dataclass(frozen=True)
class Stage:
    """One size of the cascade."""

    scale: int  # image size divided by this
    step: float  # pixels at this size that one hypothesis moves a point, in the neighbor with median parallax
    hypotheses: int  # first stage: at most; later ones: exactly, centered on the stage before
    radius: int  # pixels, of the matching window
    p1: float  # cost of a change by one hypothesis between neighboring pixels
    p2: float  # cost of a larger change

    def __post_init__(self) -> None:
        at_least(self, scale=1, hypotheses=2, p1=0, p2=0)
        above(self, step=0)
        within(self, radius=RADII)


@dataclass(frozen=True)
class StereoConfig:
    """The cascade of one keyframe."""

    stages: tuple[Stage, ...] = (
        Stage(scale=2, step=0.7, hypotheses=128, radius=2, p1=0.3, p2=2.0),
        Stage(scale=1, step=0.35, hypotheses=11, radius=2, p1=0.05, p2=0.4),
    )  # coarse to fine
    cost: CostConfig = field(default_factory=CostConfig)  # of a hypothesis
    smoothing: SmoothingConfig = field(default_factory=SmoothingConfig)  # of a stage's costs
    pruning: PruningConfig = field(default_factory=PruningConfig)  # hypotheses that need not be tried
    fill: bool = True  # between stages, where matching says nothing, from the surroundings
    depth_edges: DepthEdgeConfig | None = field(
        default_factory=DepthEdgeConfig
    )  # choice between the surfaces there; null: none

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("stages=[]: must have one stage at least")


@dataclass(frozen=True)
class StereoDepth:
    """Depth of a keyframe, unfiltered, and how sure it is."""

    depth: np.ndarray  # (H, W) float32, 0 = unknown
    confidence: np.ndarray  # (H, W) float32 0 to 1
    evidence: Evidence | None  # what the confidence was computed from
    counts: dict[str, float] = field(default_factory=dict)  # pixel-hypotheses: all, and those left out, by reason


def empty_depth(size: tuple[int, int]) -> StereoDepth:
    """No depth at all: what a keyframe without baseline has."""
    zero = np.zeros(size, dtype=np.float32)
    return StereoDepth(zero, zero.copy(), None)


def estimate_depth(
    reference: StereoKeyframe,
    neighbors: list[StereoKeyframe],
    search: SearchRange,
    config: StereoConfig,
    backend: Backend,
) -> StereoDepth:
    """Depth (H, W) at the reference's finest size. Raises ValueError without neighbors."""
    if not neighbors:
        raise ValueError("stereo needs at least one neighbor with a baseline")
    sizes = [_at_scale(reference, neighbors, stage.scale, search) for stage in config.stages]

    # 1. Sweep the whole range at the coarsest size.
    first = swept = _sweep_range(reference, sizes[0], search, config, backend)
    counts = first.counts

    # 2. At each finer size, sweep a band around the surface found so far.
    for at_size, stage in zip(sizes[1:], config.stages[1:], strict=True):
        swept = _sweep_band(swept, at_size, stage, config, backend)
        counts = {**counts, "hypotheses": counts["hypotheses"] + swept.counts["hypotheses"]}

    # 3. At depth edges, choose between the surfaces around a pixel.
    last, radius = sizes[-1], config.stages[-1].radius
    surface, gap = swept.surface, None
    if config.depth_edges is not None:
        pixel = 1.0 / max(last.moved, 1e-12)
        surface, gap = refine_depth_edges(surface, last.images, pixel, config.cost.top_k, config.depth_edges, backend)

    # 4. What all this says becomes the probability that a depth is right.
    evidence = Evidence.of(
        correlation=backend.view_correlation(last.images, surface, radius, config.cost),
        probability=swept.estimate.probability,
        margin=swept.estimate.margin,
        first_probability=_enlarge(first.estimate.probability, last.size),
        relative_pixel=1.0 / np.maximum(last.moved * surface, 1e-9),
        gray=last.images.reference,
        inverse_depth=surface,
        gap=gap,
    )
    # The best hypothesis at an end of the range: the scene may well lie outside.
    in_range = (first.estimate.best > 0) & (first.estimate.best < first.hypotheses - 1)
    known = _enlarge(in_range.astype(np.float32), last.size) > 0.5
    known &= np.isfinite(surface) & (surface > 0.5 * search.low)
    depth = np.where(known, 1.0 / np.where(known, surface, 1.0), 0.0).astype(np.float32)
    confidence = np.where(known, probability_of_inlier(evidence), 0.0).astype(np.float32)
    return StereoDepth(depth, confidence, evidence, counts)


@dataclass(frozen=True)
class _AtScale:
    """A reference and its neighbors at one size of the cascade."""

    images: MatchingImages
    moved: float  # pixels that a unit of inverse depth moves a point, in the neighbor with median parallax

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.images.reference.shape
        return height, width


def _at_scale(reference: StereoKeyframe, neighbors: list[StereoKeyframe], scale: int, search: SearchRange) -> _AtScale:
    here, gray = reference.intrinsics_at(scale), reference.gray(scale)
    warps = [relative_warp(here, reference.world_from_cam, n.intrinsics_at(scale), n.world_from_cam) for n in neighbors]
    middle = float(np.mean([search.low, search.high]))
    moved = float(np.median([parallax(w, gray.shape[:2], middle) for w in warps]))
    stack = np.ascontiguousarray(np.stack([n.gray(scale) for n in neighbors]))
    return _AtScale(MatchingImages(gray, stack, np.stack(warps).astype(np.float32)), moved)


@dataclass(frozen=True)
class _Swept:
    """What a stage found."""

    surface: np.ndarray  # (H, W) float32 inverse depth
    estimate: SurfaceEstimate
    hypotheses: int
    interval: float  # inverse depth between two of them
    gray: np.ndarray  # (H, W) the reference
    counts: dict[str, float]  # see StereoDepth


def _sweep_range(
    reference: StereoKeyframe, at_size: _AtScale, search: SearchRange, config: StereoConfig, backend: Backend
) -> _Swept:
    """The first stage: hypotheses from end to end of the range, where the tracker's depths do not rule them out."""
    stage, pruning = config.stages[0], config.pruning
    pixels = float(at_size.images.reference.size)
    count = stage.hypotheses
    if pruning.outside_range:
        needed = int(np.ceil((search.high - search.low) / (stage.step / max(at_size.moved, 1e-12)))) + 1
        count = int(np.clip(needed, 8, stage.hypotheses))
    interval = (search.high - search.low) / (count - 1)
    tiles = None
    if pruning.outside_cells:
        tiles = tiles_in_cells(reference, at_size.size, search.low, interval, count, pruning)
    counts = {
        "outside the range": (stage.hypotheses - count) * pixels,
        "outside the cells": 0.0 if tiles is None else float(1.0 - tiles.mean()) * count * pixels,
    }
    first = np.full(at_size.size, search.low, dtype=np.float32)
    return _sweep(at_size, first, interval, count, stage, config, backend, tiles, counts)


def _sweep_band(before: _Swept, at_size: _AtScale, stage: Stage, config: StereoConfig, backend: Backend) -> _Swept:
    """A later stage: a few hypotheses on both sides of the surface of the stage before."""
    surface = before.surface
    if config.fill:
        surface = fill_uncertain(surface, certainty(before.estimate), before.gray)
    interval = min(stage.step / max(at_size.moved, 1e-12), before.interval)
    centers = upsample_surface(surface, at_size.size, 1.5 * before.interval)
    first = centers - np.float32(interval * (stage.hypotheses - 1) / 2)
    return _sweep(at_size, first, interval, stage.hypotheses, stage, config, backend, None, {})


def _sweep(
    at_size: _AtScale,
    first: np.ndarray,
    interval: float,
    count: int,
    stage: Stage,
    config: StereoConfig,
    backend: Backend,
    tiles: np.ndarray | None,
    pruned: dict[str, float],
) -> _Swept:
    """The smoothest surface of least cost among `count` hypotheses from `first` on."""
    step = np.full(at_size.size, interval, dtype=np.float32)
    gray = at_size.images.reference
    cost = backend.cost_volume(at_size.images, first, step, count, stage.radius, config.cost, tiles)
    estimate = backend.semi_global(cost, gray, first, step, stage.p1, stage.p2, config.smoothing)
    surface = first + estimate.index * np.float32(interval)
    return _Swept(surface, estimate, count, interval, gray, {"hypotheses": float(count) * gray.size, **pruned})


def _enlarge(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR))
