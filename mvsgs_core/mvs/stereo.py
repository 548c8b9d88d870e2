"""Depth of one reference view from its neighbors: sweep, smooth, narrow the search, repeat at the next size."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from mvsgs_core.mvs.confidence import Evidence, probability_of_inlier
from mvsgs_core.mvs.depth_edges import DepthEdgeConfig, refine_depth_edges
from mvsgs_core.mvs.hypotheses import SearchRange, certainty, fill_uncertain, upsample_surface
from mvsgs_core.mvs.interface import Backend, Choice, CostOptions, SmoothOptions
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.mvs.pruning import PruningConfig, tiles_in_cells
from mvsgs_core.warp import parallax, relative_warp


@dataclass(frozen=True)
class Stage:
    """One size of the cascade."""

    scale: int  # image size divided by this
    step: float  # pixels at this size that one hypothesis moves a point, in the neighbor with median parallax
    hypotheses: int  # first stage: at most; later ones: exactly, centered on the stage before
    radius: int  # pixels, of the matching window
    p1: float  # smoothing penalties, see SmoothOptions
    p2: float


@dataclass(frozen=True)
class StereoConfig:
    """The cascade of one view."""

    stages: tuple[Stage, ...] = (
        Stage(scale=2, step=0.7, hypotheses=128, radius=2, p1=0.3, p2=2.0),
        Stage(scale=1, step=0.35, hypotheses=11, radius=2, p1=0.05, p2=0.4),
    )
    top_k: int = 3  # of the neighbors, per pixel and hypothesis: the others may be occluded
    noise: float = 1.5  # gray levels²
    contrast: float = 8.0  # gray levels: what differs so from a window's center counts 1 / e in it
    edge: float = 12.0  # gray levels
    break_steps: float = 4.0  # hypotheses
    temperature: float = 0.02  # cost
    paths: int = 8  # 4 or 8
    fill: bool = True  # between stages, where matching says nothing, from the surroundings
    depth_edges: DepthEdgeConfig | None = field(default_factory=DepthEdgeConfig)
    skips: PruningConfig = field(default_factory=PruningConfig)

    def cost_options(self, stage: Stage) -> CostOptions:
        return CostOptions(stage.radius, self.top_k, self.noise, self.contrast)

    def smooth_options(self, stage: Stage) -> SmoothOptions:
        return SmoothOptions(stage.p1, stage.p2, self.edge, self.break_steps, self.temperature, self.paths)


@dataclass(frozen=True)
class StereoDepth:
    """Depth of a view, unfiltered, and how sure it is."""

    depth: np.ndarray  # (H, W) float32, 0 = unknown
    confidence: np.ndarray  # (H, W) float32 0 to 1
    evidence: Evidence | None  # what the confidence was computed from
    counts: dict[str, float] = field(default_factory=dict)  # pixel-hypotheses: all, and those left out by each skip


def empty_depth(size: tuple[int, int]) -> StereoDepth:
    """No depth at all: what a view without baseline has."""
    zero = np.zeros(size, dtype=np.float32)
    return StereoDepth(zero, zero.copy(), None)


def estimate_depth(
    reference: StereoKeyframe,
    neighbors: list[StereoKeyframe],
    search: SearchRange,
    config: StereoConfig,
    backend: Backend,
) -> StereoDepth:
    """Depth (H, W) at the reference's finest stage. Raises ValueError without neighbors."""
    if not neighbors:
        raise ValueError("stereo needs at least one neighbor with a baseline")
    middle = float(np.mean([search.low, search.high]))
    counts = dict.fromkeys(("hypotheses", "outside the range", "outside the cells"), 0.0)
    skips = config.skips
    surface = np.empty((0, 0), dtype=np.float32)
    first_probability = surface
    interval = 0.0
    choice: Choice | None = None
    in_range = np.empty((0, 0), dtype=bool)
    for number, stage in enumerate(config.stages):
        gray = reference.gray(stage.scale)
        warps = _warps(reference, neighbors, stage.scale)
        images = _stack(neighbors, stage.scale)
        moved = float(np.median([parallax(w, gray.shape[:2], middle) for w in warps]))
        size = (gray.shape[0], gray.shape[1])
        wanted = stage.step / max(moved, 1e-12)
        if number == 0:
            needed = int(np.ceil((search.high - search.low) / wanted)) + 1
            count = int(np.clip(needed, 8, stage.hypotheses)) if skips.outside_range else stage.hypotheses
            interval = (search.high - search.low) / (count - 1)
            first: np.ndarray = np.full(size, search.low, dtype=np.float32)
            counts["outside the range"] += float(stage.hypotheses - count) * gray.size
            tiles = tiles_in_cells(reference, size, search.low, interval, count, skips) if skips.outside_cells else None
            counts["outside the cells"] += 0.0 if tiles is None else float(1.0 - tiles.mean()) * count * gray.size
        else:
            count = stage.hypotheses
            previous = interval
            assert choice is not None
            if config.fill:
                surface = fill_uncertain(surface, certainty(choice), reference.gray(config.stages[number - 1].scale))
            interval = min(wanted, previous)
            centers = upsample_surface(surface, size, 1.5 * previous)
            first = centers - np.float32(interval * (count - 1) / 2)
            tiles = None
        step = np.full(size, interval, dtype=np.float32)
        cost = backend.cost_volume(
            gray, images, warps.astype(np.float32), first, step, count, config.cost_options(stage), tiles
        )
        choice = backend.semi_global(cost, gray, first, step, config.smooth_options(stage))
        surface = first + choice.index * np.float32(interval)
        counts["hypotheses"] += float(count) * gray.size
        if number == 0:
            first_probability = choice.probability
            # The best hypothesis at an end of the range: the scene may well lie outside.
            in_range = (choice.best > 0) & (choice.best < count - 1)
    assert choice is not None
    last = config.stages[-1]
    size = (surface.shape[0], surface.shape[1])
    warps = _warps(reference, neighbors, last.scale)
    gray = reference.gray(last.scale)
    images = _stack(neighbors, last.scale)
    options = config.cost_options(last)
    moved = float(np.median([parallax(w, size, middle) for w in warps]))
    gap = np.zeros(size, dtype=np.float32)
    if config.depth_edges is not None:
        pixel = 1.0 / max(moved, 1e-12)
        surface, gap = refine_depth_edges(
            surface, gray, images, warps.astype(np.float32), pixel, options, config.depth_edges, backend
        )
    correlation = backend.view_correlation(gray, images, warps.astype(np.float32), surface, options)
    evidence = Evidence.of(
        correlation=correlation,
        probability=choice.probability,
        margin=choice.margin,
        first_probability=_enlarge(first_probability, size),
        relative_pixel=1.0 / np.maximum(moved * surface, 1e-9),
        gray=gray,
        inverse_depth=surface,
        gap=gap,
    )
    known = _enlarge(in_range.astype(np.float32), size) > 0.5
    known &= np.isfinite(surface) & (surface > 0.5 * search.low)
    depth = np.where(known, 1.0 / np.where(known, surface, 1.0), 0.0).astype(np.float32)
    confidence = np.where(known, probability_of_inlier(evidence), 0.0).astype(np.float32)
    return StereoDepth(depth, confidence, evidence, counts)


def _warps(reference: StereoKeyframe, neighbors: list[StereoKeyframe], scale: int) -> np.ndarray:
    here = reference.intrinsics_at(scale)
    return np.stack(
        [relative_warp(here, reference.world_from_cam, n.intrinsics_at(scale), n.world_from_cam) for n in neighbors]
    )


def _stack(neighbors: list[StereoKeyframe], scale: int) -> np.ndarray:
    """(N, h, w) images, all of one size (a change of size starts a new window in Cascade)."""
    return np.ascontiguousarray(np.stack([n.gray(scale) for n in neighbors]))


def _enlarge(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(cv2.resize(values, (size[1], size[0]), interpolation=cv2.INTER_LINEAR))
