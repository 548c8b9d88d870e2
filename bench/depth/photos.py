"""Facades and aerial photographs, wide steps and no true depth: scored by what does not need it.

- kept: part of all pixels that the filters leave.
- agreement: median relative difference between a kept depth and the kept depth of another keyframe that sees the point.
- reprojection: correlation (ZNCC, 7x7) of kept pixels with a photograph that took no part in their stereo.
- the tracker's points: kept depths within 5 % of the triangulated depth of the cell (weight 0.5 or more) they lie in.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from bench.depth.run import Run, run
from bench.depth.tracked import Collected
from bench.runs import DATA
from bench.table import Row, skipped
from msgs import Frame, GroundTruth
from mvsgs_core.datasets import open_dataset
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig
from mvsgs_core.mvs.backend import NativeBackend
from mvsgs_core.mvs.cascade import CascadeConfig
from mvsgs_core.mvs.interface import MatchingImages
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.mvs.matching_cost import CostConfig
from mvsgs_core.warp import apply_warp, relative_warp
from nodes.posed_tracker import PosedTracker
from nodes.tracker import Tracker


@dataclass(frozen=True)
class Photos:
    """A set of photographs; without true poses the tracker's are taken."""

    folder: str
    posed: bool
    options: dict[str, Any] = field(default_factory=dict)


PHOTOS = {
    "fountain-P11": Photos("strecha/fountain-P11", True, {"size": 240000}),
    "Herz-Jesus-P8": Photos("strecha/Herz-Jesus-P8", True, {"size": 240000}),
    "aerial_caliterra": Photos("aerial_caliterra", False, {"size": 270000}),
}


def photo_rows(area: int, names: list[str]) -> list[Row]:
    rows = []
    for name in names:
        if not (DATA / PHOTOS[name].folder).exists():
            rows.append(skipped(name, DATA / PHOTOS[name].folder))
            continue
        views = load_photos(PHOTOS[name], area)
        if len(views) < 3:
            rows.append(Row(f"{name}: keyframes that the tracker gave, too few for stereo", float(len(views))))
            continue
        rows += _scores(name, views, run(views, CascadeConfig(area=area), FusionConfig()))
    return rows


def load_photos(photos: Photos, area: int) -> list[StereoKeyframe]:
    """Keyframes with poses and coarse depth: triangulated by the posed tracker, or all by the tracker."""
    tracker, sent = PosedTracker() if photos.posed else Tracker(), Collected()
    for item in open_dataset("images", path=DATA / photos.folder, **photos.options):
        sent.take(tracker.on_frame(Frame(item.index, item.timestamp, item.image, item.intrinsics)))
        if isinstance(tracker, PosedTracker):
            pose = item.world_from_cam
            sent.take(tracker.on_ground_truth(
                GroundTruth(item.index, item.timestamp, item.image, item.intrinsics, pose, None)
            ))  # fmt: skip
    sent.take(tracker.on_end())
    return sent.views(area, (1, 2))


def _scores(name: str, views: list[StereoKeyframe], found: Run) -> list[Row]:
    by_index = {v.index: v for v in views}
    differences, correlations, near_points = [], [], []
    for stereo, fused in zip(found.stereo, found.fused, strict=True):
        reference = by_index[fused.view.index]
        differences += [_difference(fused, other) for other in found.fused if other is not fused]
        apart = [v for v in views if v.index not in stereo.neighbors and v.index != reference.index]
        if apart:
            nearest = min(apart, key=lambda v: abs(v.index - reference.index))
            correlations.append(_correlation(fused, reference, nearest))
        near_points.append(_ratio_to_points(fused, reference))
    kept = sum(f.counts["kept"] for f in found.fused) / sum(f.counts["pixels"] for f in found.fused)
    ratios = np.concatenate(near_points)
    height, width = views[0].size
    return [
        Row(f"{name}, {len(views)} keyframes at {width}x{height}: kept", kept),
        Row(f"{name}: agreement of kept depths, median difference", _median(differences)),
        Row(f"{name}: reprojection into another photograph, median correlation", _median(correlations)),
        Row(f"{name}: kept within 5 % of the tracker's points", float(np.mean(np.abs(ratios - 1.0) < 0.05))),
    ]


def _median(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0)
    return float(np.median(values)) if len(values) else float("nan")


def _difference(one: FusedDepth, other: FusedDepth) -> np.ndarray:
    """(K,) relative differences of kept depths where both see the point; what is hidden behind it is left out."""
    v, u = np.nonzero(one.depth > 0)
    a, b = one.view, other.view
    warp = relative_warp(a.intrinsics, a.world_from_cam, b.intrinsics, b.world_from_cam)
    inverse = 1.0 / one.depth[v, u].astype(np.float64)
    x, y, z = apply_warp(warp, u.astype(np.float64), v.astype(np.float64), inverse)
    height, width = other.depth.shape
    inside = (z > 1e-9) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    there = other.depth[np.round(y[inside]).astype(int), np.round(x[inside]).astype(int)]
    expected = z[inside] / inverse[inside]
    difference = np.abs(there - expected) / expected
    return np.asarray(difference[(there > 0) & (difference < 0.25)])


def _correlation(fused: FusedDepth, reference: StereoKeyframe, other: StereoKeyframe) -> np.ndarray:
    """(K,) ZNCC of kept pixels that `other` sees."""
    kept = fused.depth > 0
    inverse = np.where(kept, 1.0 / np.where(kept, fused.depth, 1.0), 1.0).astype(np.float32)
    warp = relative_warp(reference.intrinsics, reference.world_from_cam, other.intrinsics, other.world_from_cam)
    images = MatchingImages(reference.gray(1), other.gray(1)[None], warp[None].astype(np.float32))
    found = NativeBackend().view_correlation(images, inverse, radius=2, cost=CostConfig())[0]
    return np.asarray(found[kept & (found > -1.5)])


def _ratio_to_points(fused: FusedDepth, reference: StereoKeyframe) -> np.ndarray:
    """(K,) kept depth over the tracker's in its confident cells."""
    cells = reference.inverse_depth.shape
    depth = cv2.resize(fused.depth, cells[::-1], interpolation=cv2.INTER_NEAREST)
    both = (depth > 0) & (reference.inverse_depth > 0) & (reference.weight >= 0.5)
    return np.asarray((depth * reference.inverse_depth)[both])
