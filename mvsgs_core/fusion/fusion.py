"""Online fusion: depth maps in, with two more keyframes of lag refined and filtered ones out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.fusion.backend import make_fusion_backend
from mvsgs_core.fusion.confidence import features_of, probability_of_inlier, uncertainty_of
from mvsgs_core.fusion.interface import FuseOptions, FusionBackend
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth, depth_maps
from mvsgs_core.fusion.normals import normals_of
from mvsgs_core.keyframe_window import WindowedStage
from mvsgs_core.pace import Effort, Pace, check_efforts, check_share
from mvsgs_core.setting_ranges import at_least, within

ANY_DEPTH = 1.0  # relative difference that no two positive depths reach
EFFORTS = (Effort("full", 1.0), Effort("two neighbors", 0.4), Effort("no neighbor", 0.15))


@dataclass(frozen=True)
class FusionConfig:
    """Refinement and filters; lengths are relative to depth."""

    lag: int = 2  # keyframes after the reference that are waited for
    window: int = 4  # keyframes before the reference that may be neighbors
    neighbors: int = 6  # depth maps that a reference is checked with
    refine: bool = True  # depth and confidence from the neighbors' maps (counterpart of V-FUSE)
    sigma: float = 0.01  # relative depth: width of the support, at least
    sigma_most: float = 0.1  # and at most, where the neighbors have little parallax: see `uncertainty_of`
    violation: float = 1.0  # weight of free-space violations against support
    # a neighbor's pixel below takes no part in the refinement, a map that is all below it says nothing against a depth
    min_neighbor_confidence: float = 0.1
    check: bool = True  # geometric consistency
    relative: float = 0.02  # relative depth difference that still agrees; refined, the support's width if that is more
    min_views: int = 2  # views that must agree, the reference counted; 1: its own depth will do
    confidence: float = 0.755  # of a kept pixel at least: lower keeps more, with more outliers
    device: str = "auto"  # auto (CUDA if there is one), cpu (C++), torch (PyTorch on the CPU), cuda
    threads: int | None = None  # of the C++ kernels; null: all
    realtime: bool = False  # less effort, see `EFFORTS`, where depth maps come faster than they are fused
    share: float = 0.35  # of a core's time that fusion may take then
    efforts: tuple[int, ...] | None = None  # those that may be made then, by their place among all; null: all

    def __post_init__(self) -> None:
        at_least(self, lag=0, window=0, neighbors=0, sigma=0, sigma_most=0, violation=0, relative=0)
        within(self, min_neighbor_confidence=(0, 1), confidence=(0, 1))
        check_share(self.share)
        check_efforts(EFFORTS, self.efforts)


@dataclass(frozen=True)
class FusedDepth:
    """One keyframe's filtered depth."""

    view: KeyframeDepth  # as it came, pose and scale corrected
    depth: np.ndarray  # (H, W) float32, 0 where filtered out
    unfiltered: np.ndarray  # (H, W) float32 refined depth before the filters
    confidence: np.ndarray  # (H, W) float32 refined, calibrated
    normals: np.ndarray  # (H, W, 3) float32 camera frame, 0 where depth is 0
    consistent: np.ndarray  # (H, W) uint8 neighbors that agree
    # pixels in all, those with depth of their own or of neighbors, and of these those kept, and rejected by each filter
    counts: dict[str, float] = field(default_factory=dict)
    evidence: np.ndarray | None = None  # (F, H, W) float32 what the confidence was computed from
    problem: str = ""  # a limit that had to be relaxed, or why nothing is kept
    effort: int = 0  # of `EFFORTS`


class OnlineFusion(WindowedStage[KeyframeDepth, FusedDepth]):
    """Fused depth of each keyframe."""

    def __init__(self, config: FusionConfig | None = None) -> None:
        self.config = c = config or FusionConfig()
        super().__init__(c.window, c.lag)
        self._backend = make_fusion_backend(c.device, c.threads)
        fewer = replace(c, neighbors=min(2, c.neighbors))
        self._ways = (c, fewer, replace(c, neighbors=0, check=False))  # one an effort
        self.pace = Pace(EFFORTS, c.share, only=c.efforts if c.realtime else (0,))

    def _result(self, reference: KeyframeDepth, others: list[KeyframeDepth]) -> FusedDepth:
        with self.pace.spend() as effort:
            found = self._fuse(reference, others, self._ways[effort])
        return replace(found, effort=effort)

    def _fuse(self, reference: KeyframeDepth, others: list[KeyframeDepth], config: FusionConfig) -> FusedDepth:
        neighbors = nearest_views(reference, others, config.neighbors, config.min_neighbor_confidence)
        return fuse(self._prepared(reference, neighbors), neighbors, config, self._backend)

    def _prepared(self, reference: KeyframeDepth, neighbors: list[KeyframeDepth]) -> KeyframeDepth:
        """Where a subclass puts a network in the place of the weight-free refinement."""
        return reference


def nearest_views(
    reference: KeyframeDepth, others: list[KeyframeDepth], count: int, min_confidence: float
) -> list[KeyframeDepth]:
    """Of the maps that have depth at all, those that see most of the reference's points; ties: the wider baseline.

    Doubtful maps come last: see `KeyframeDepth.doubtful`.
    """
    known = reference.depth > 0
    if not known.any():
        return []
    v, u = np.nonzero(known)
    chosen = slice(None, None, max(1, len(v) // 300))
    u, v = u[chosen], v[chosen]
    z = reference.depth[v, u].astype(np.float64)
    fx, fy, cx, cy = reference.intrinsics
    points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1)
    world = points @ reference.world_from_cam[:3, :3].T + reference.world_from_cam[:3, 3]
    scored = []
    for other in others:
        if not (other.depth > 0).any():
            continue
        cam_from_world = geometry.inverse(other.world_from_cam)
        local = world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        front = local[:, 2] > 1e-9
        safe = np.where(front, local[:, 2], 1.0)
        x = other.intrinsics[0] * local[:, 0] / safe + other.intrinsics[2]
        y = other.intrinsics[1] * local[:, 1] / safe + other.intrinsics[3]
        overlap = np.mean(front & (x >= 0) & (x < other.size[1]) & (y >= 0) & (y < other.size[0]))
        baseline = np.linalg.norm(other.world_from_cam[:3, 3] - reference.world_from_cam[:3, 3])
        if overlap > 0.1:
            rank = other.doubtful(min_confidence), -round(float(overlap), 1), -float(baseline), other.index
            scored.append((rank, other))
    return [other for _, other in sorted(scored, key=lambda entry: entry[0])[:count]]


def fuse(
    reference: KeyframeDepth, neighbors: list[KeyframeDepth], config: FusionConfig, backend: FusionBackend
) -> FusedDepth:
    """Refines and filters one map with its neighbors', all of one size."""
    known = reference.depth > 0
    depth, confidence = reference.depth, reference.confidence
    consistent = np.zeros(reference.size, dtype=np.uint8)
    problem = ""
    evidence: np.ndarray | None = None
    counts: dict[str, float] = {"pixels": float(depth.size)}
    if neighbors:
        maps = depth_maps(reference, neighbors)
        within = np.full(reference.size, config.relative, dtype=np.float32)
        if config.refine:
            options = FuseOptions(config.violation, config.min_neighbor_confidence)
            splatted = backend.splat(maps, options)
            first = np.where(known, depth, np.where(splatted > 0, splatted, np.inf).min(axis=0)).astype(np.float32)
            first[np.isinf(first)] = 0.0
            doubt = uncertainty_of(backend.parallax(replace(maps, depth=first)))
            width = np.clip(doubt, config.sigma, max(config.sigma, config.sigma_most))
            fused = backend.fuse(maps, splatted, width, options)
            depth = fused.depth
            maps = replace(maps, depth=depth)
            doubt = uncertainty_of(backend.parallax(maps))
            within = np.clip(doubt, config.relative, max(config.relative, config.sigma_most))
        doubtful = np.array([n.doubtful(config.min_neighbor_confidence) for n in neighbors])
        certain = maps.of(~doubtful)
        consistent = backend.consistent_views(certain, within)
        if config.refine:
            seeing = backend.consistent_views(certain, np.full_like(depth, ANY_DEPTH))
            evidence = features_of(fused, confidence, consistent, seeing, doubt)
            confidence = np.where(depth > 0, probability_of_inlier(evidence), 0.0).astype(np.float32)
        if doubtful.any():  # such a map may agree, and is not heard where it does not
            consistent += backend.consistent_views(maps.of(doubtful), within)
    if reference.mask is not None:  # the neighbors may well see what is behind there
        depth = np.where(reference.mask, depth, np.float32(0))
    keep = depth > 0
    counts["with depth"] = float(keep.sum())
    sure = confidence >= config.confidence
    counts["rejected: confidence"] = float((keep & ~sure).sum())
    if config.check:
        needed = config.min_views - 1
        if len(neighbors) < needed:
            needed = len(neighbors)
            problem = "too few neighbors for the consistency check" if needed else "no neighbor to check depth with"
        agreed = consistent >= (max(needed, 1) if config.min_views > 1 else 0)
        counts["rejected: consistency"] = float((keep & ~agreed).sum())
        keep = keep & agreed
    keep = keep & sure
    counts["kept"] = float(keep.sum())
    filtered = np.where(keep, depth, 0.0).astype(np.float32)
    normals = normals_of(filtered, reference.intrinsics)
    return FusedDepth(reference, filtered, depth, confidence, normals, consistent, counts, evidence, problem)
