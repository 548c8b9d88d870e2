"""Fits and checks the confidences: `python -m bench.depth.calibration`.

Prints the constants of mvsgs_core/mvs/confidence.py and mvsgs_core/fusion/confidence.py, by logistic regression of
"within 5 % of the truth", each scene with the same weight, and how well they hold on scenes that took no part.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from bench.depth.data import Scene, load_scene
from bench.depth.run import Run, run, scaled_to
from bench.depth.tracked import load_tracked
from bench.table import Row
from mvsgs_core.fusion import confidence as fused_confidence
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs import confidence as stereo_confidence
from mvsgs_core.mvs.cascade import CascadeConfig

INLIER = 0.05  # relative error
MEAN = {10: 0.7}  # of fusion's features, the mean of the whole map: no map of these scenes fails as a whole
FIT = ("room", "aerial", "town", "replica", "fr1_xyz tracked")
CHECK = ("room_b", "icl_nuim", "redkitchen tracked")


def load(name: str, area: int) -> Scene:
    """`tracked`: with the tracker's poses, because those of the real sets do not fit their images to a pixel."""
    sequence, _, how = name.partition(" ")
    return load_tracked(sequence, area) if how else load_scene(sequence, area)


def samples(scene: Scene, area: int, edges: bool = True) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Features (N, F) and inlier labels (N,) of "stereo" and "fusion", of pixels with depth and truth.

    edges: with the choice of surfaces at depth edges.
    """
    cascade = CascadeConfig(area=area) if edges else CascadeConfig(area=area, depth_edges=None)
    found = run(scene.views, cascade, FusionConfig())
    rows: dict[str, list[np.ndarray]] = {"stereo": [], "fusion": []}
    labels: dict[str, list[np.ndarray]] = {"stereo": [], "fusion": []}
    for stereo, fused, truth in zip(found.stereo, found.fused, scene.truths, strict=True):
        if truth is None or stereo.result.evidence is None or fused.evidence is None:
            continue
        for name, depth, features in (
            ("stereo", stereo.result.depth, stereo.result.evidence.features()),
            ("fusion", fused.unfiltered, fused.evidence),
        ):
            use = (truth > 0) & (depth > 0)
            if scene.name.endswith("tracked"):
                depth = depth * np.median(truth[use] / depth[use])
            rows[name].append(features[:, use].T[::7])
            labels[name].append((np.abs(depth[use] - truth[use]) < INLIER * truth[use])[::7])
    return {name: (np.concatenate(rows[name]), np.concatenate(labels[name])) for name in rows}


def fit(
    scenes: list[tuple[np.ndarray, np.ndarray]], given: Mapping[int, float] = MappingProxyType({}), ridge: float = 1e-3
) -> np.ndarray:
    """Logistic regression (F,) by Newton's method, from each scene's features (N, F) and labels (N,).

    given: weights by the number of their feature, which stay as they are.
    """
    x = np.concatenate([features for features, _ in scenes]).astype(np.float64)
    labels = np.concatenate([labels for _, labels in scenes])
    share = np.concatenate([np.full(len(labels), 1.0 / len(labels) / len(scenes)) for _, labels in scenes])
    weights = np.zeros(x.shape[1])
    weights[list(given)] = list(given.values())
    free = np.setdiff1d(np.arange(len(weights)), list(given))
    for _ in range(30):
        probability = 1.0 / (1.0 + np.exp(-x @ weights))
        gradient = x.T @ (share * (labels - probability)) - ridge * weights
        hessian = (x * (share * probability * (1 - probability))[:, None]).T @ x + ridge * np.eye(len(weights))
        step = np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        weights[free] += step
        if np.abs(step).max() < 1e-8:
            break
    return weights


def reliability(
    probability: np.ndarray, labels: np.ndarray, bins: int = 10
) -> tuple[float, list[tuple[float, float, float]]]:
    """Expected calibration error, and (mean confidence, inliers, fraction of pixels) of each bin."""
    curve = []
    error = 0.0
    which = np.minimum((probability * bins).astype(int), bins - 1)
    for b in range(bins):
        inside = which == b
        if inside.any():
            fraction = float(inside.mean())
            curve.append((float(probability[inside].mean()), float(labels[inside].mean()), fraction))
            error += fraction * abs(curve[-1][0] - curve[-1][1])
    return error, curve


def print_reliability(name: str, tag: str, probability: np.ndarray, labels: np.ndarray) -> None:
    error, curve = reliability(probability, labels)
    text = " ".join(f"{c:.2f}:{i:.2f}({s:.2f})" for c, i, s in curve)
    print(f"  {name:18s} {tag:12s} calibration error {error:.3f}  confidence:inliers(fraction) {text}")


def calibration_rows(scene: Scene, found: Run, align: bool, bins: int = 5) -> list[Row]:
    """Inliers (within 5 %) among the pixels of each range of confidence, of stereo and after fusion, unfiltered."""
    rows = []
    maps = {
        "stereo": [(d.result.depth, d.result.confidence) for d in found.stereo],
        "fusion": [(f.unfiltered, f.confidence) for f in found.fused],
    }
    for kind, pairs in maps.items():
        probability, labels = [], []
        for (depth, confidence), truth in zip(pairs, scene.truths, strict=True):
            if truth is None:
                continue
            use = (truth > 0) & (depth > 0)
            scaled = scaled_to(depth, truth) if align else depth
            probability.append(confidence[use])
            labels.append(np.abs(scaled[use] - truth[use]) < INLIER * truth[use])
        if not any(len(p) for p in probability):
            continue
        error, curve = reliability(np.concatenate(probability), np.concatenate(labels), bins)
        text = ", ".join(f"{c:.2f}: {i:.2f} ({100 * s:.0f} %)" for c, i, s in curve)
        rows.append(Row(f"calibration, {scene.name}, {kind}: error", error))
        rows.append(Row(f"calibration, {scene.name}, {kind}: confidence: inliers (fraction of pixels)", text))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--area", type=int, default=320 * 240)
    options = parser.parse_args()
    data = {}
    for name in (*FIT, *CHECK):
        scene = load(name, options.area)
        data[name] = samples(scene, options.area)
        data[name]["stereo without gap"] = samples(scene, options.area, edges=False)["stereo"]
    for kind, inside in (
        ("stereo", stereo_confidence.WEIGHTS),
        ("stereo without gap", stereo_confidence.WITHOUT_GAP),
        ("fusion", fused_confidence.WEIGHTS),
    ):
        weights = fit([data[name][kind] for name in FIT], MEAN if kind == "fusion" else {})
        print(f"{kind}: WEIGHTS = np.array({np.round(weights, 3).tolist()})")
        for name in data:
            features, labels = data[name][kind]
            for tag, w in (("fitted now", weights), ("in the code", inside)):
                probability = 1.0 / (1.0 + np.exp(-features @ w))
                print_reliability(name, tag, probability, labels)


if __name__ == "__main__":
    main()
