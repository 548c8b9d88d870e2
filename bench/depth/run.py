"""Runs stereo and fusion over a scene's keyframes, and scores depth maps."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from bench.depth.data import Scene
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig, OnlineFusion
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig, CascadeDepth
from mvsgs_core.mvs.keyframe import StereoKeyframe


@dataclass(frozen=True)
class Run:
    """What came out, keyframe by keyframe, and the median time of each stage."""

    stereo: list[CascadeDepth]
    fused: list[FusedDepth]
    stereo_seconds: float
    fusion_seconds: float
    processor_seconds: float = 0.0  # of both, a keyframe, all threads together


@dataclass(frozen=True)
class Score:
    """Of the pixels with true depth."""

    inliers: float  # part of the kept ones within the tolerance
    completeness: float  # part that is kept
    relative_error: float  # mean absolute, of the kept ones


def run(views: list[StereoKeyframe], cascade: CascadeConfig, fusion: FusionConfig) -> Run:
    """Stereo and fusion of views in stream order."""
    stereo_node, fusion_node = Cascade(cascade), OnlineFusion(fusion)
    begin = time.process_time()
    stereo: list[CascadeDepth] = []
    fused: list[FusedDepth] = []
    stereo_times: list[float] = []
    fusion_times: list[float] = []

    def keep(found: list[CascadeDepth]) -> None:
        stereo.extend(found)
        for one in found:
            start = time.perf_counter()
            out = list(fusion_node.add(depth_view(one)))
            if out:
                fusion_times.append((time.perf_counter() - start) / len(out))
            fused.extend(out)

    for view in views:
        start = time.perf_counter()
        found = list(stereo_node.add(view))
        if found:
            stereo_times.append((time.perf_counter() - start) / len(found))
        keep(found)
    keep(list(stereo_node.flush()))
    fused.extend(fusion_node.flush())
    median = [float(np.median(t)) if t else 0.0 for t in (stereo_times, fusion_times)]
    return Run(stereo, fused, median[0], median[1], (time.process_time() - begin) / max(1, len(views)))


def depth_view(found: CascadeDepth) -> KeyframeDepth:
    view = found.view
    return KeyframeDepth(
        view.index, found.result.depth, found.result.confidence, view.intrinsics, view.world_from_cam, view.scale,
        view.segment,
    )  # fmt: skip


def score(depths: list[np.ndarray], scene: Scene, align: bool = False) -> Score:
    """Pooled over keyframes with truth. `align`: each map's median ratio to the truth is divided out."""
    errors, total = [], 0
    for depth, truth in zip(depths, scene.truths, strict=True):
        if truth is None:
            continue
        known = truth > 0
        total += int(known.sum())
        kept = known & (depth > 0)
        if not kept.any():
            continue
        if align:
            depth = scaled_to(depth, truth)
        errors.append(np.abs(depth[kept] - truth[kept]) / truth[kept])
    if not errors or total == 0:
        return Score(float("nan"), 0.0, float("nan"))
    error = np.concatenate(errors)
    return Score(
        inliers=float(np.mean(error < scene.tolerance)),
        completeness=len(error) / total,
        relative_error=float(error.mean()),
    )


def surest(found: Run, scene: Scene, completeness: float) -> list[np.ndarray]:
    """The kept depths (H, W) of the highest confidence, so many that they are `completeness` of the true depths."""
    sure = [np.where(f.depth > 0, f.confidence, 0.0) for f in found.fused]
    pooled = np.concatenate([c[t > 0] for c, t in zip(sure, scene.truths, strict=True) if t is not None])
    limit = np.quantile(pooled, 1.0 - completeness)
    return [np.where(c >= limit, f.depth, 0).astype(np.float32) for c, f in zip(sure, found.fused, strict=True)]


def scaled_to(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A map (H, W) with its median ratio to the truth divided out."""
    both = (truth > 0) & (depth > 0)
    factor = np.median(truth[both] / depth[both]) if both.any() else 1.0
    return (depth * factor).astype(np.float32)
