"""Where parallax is small: a car that drives straight on, and bare walls; scored by the tracker's own points.

A point is verified where two other keyframes see it within a pixel of where it should be, and a pixel moves its depth
by less than a tenth. Half of all the tracker's points, by chance, are kept from stereo, and score it.

- kept: part of the pixels that the filters leave; of a street those below the horizon, which lies at the image's
  principal point, as the camera is level.
- outliers: kept depths at verified points that stereo did not have, 5 % or more off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bench.depth.run import Run, run
from bench.depth.tracked import Collected
from bench.runs import DATA
from bench.table import Row, at_least, at_most, skipped
from msgs import Frame
from mvsgs_core.datasets import open_dataset
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig
from mvsgs_core.mvs.keyframe import StereoKeyframe
from mvsgs_core.tracking.graph import KeyframeGraph
from nodes.tracker import Tracker

WITHIN = 0.05  # relative depth
REASONS = ("confidence", "consistency")


@dataclass(frozen=True)
class Street:
    """A sequence, what part of its pixels should be kept, and whether only those below the horizon count."""

    dataset: str
    folder: str
    kept: float
    below_horizon: bool


STREETS = {
    "kitti_piece": Street("tum", "kitti_piece", 0.4, True),
    "icl_nuim": Street("icl_nuim", "icl_nuim_of_kt0", 0.5, False),
}


@dataclass(frozen=True)
class Points:
    """Verified points of a keyframe, as fractions of the image's width and height."""

    at: np.ndarray  # (K, 2) float64
    inverse_depth: np.ndarray  # (K,) float64
    cell: np.ndarray  # (K,) where they are in the keyframe's grid, row by row


def street_rows(area: int) -> list[Row]:
    rows = []
    for name, street in STREETS.items():
        if not (DATA / street.folder).exists():
            rows.append(skipped(name, DATA / street.folder))
            continue
        views, points = load_street(street, area)
        withheld = [np.random.default_rng(v.index).random(v.weight.size) < 0.5 for v in views]
        given = [_without(view, held) for view, held in zip(views, withheld, strict=True)]
        found = run(given, CascadeConfig(area=area), FusionConfig())
        rows += _scores(name, street, found, points, withheld)
    return rows


def load_street(street: Street, area: int) -> tuple[list[StereoKeyframe], list[Points | None]]:
    """Keyframes as the tracker has them at the end, and their verified points; None where it dropped the keyframe."""
    tracker, sent = Tracker(), Collected()
    for item in open_dataset(street.dataset, path=DATA / street.folder):
        sent.take(tracker.on_frame(Frame(item.index, item.timestamp, item.image, item.intrinsics)))
    sent.take(tracker.on_end())
    graph, views = tracker.core.session.graph, sent.views(area, (1, 2))
    return views, [verified(graph, view.index) if view.index in graph.keyframes else None for view in views]


def verified(graph: KeyframeGraph, index: int, pixels: float = 1.0, relative: float = 0.1, views: int = 2) -> Points:
    keyframe = graph.keyframes[index]
    seen = np.zeros(len(keyframe.inverse_depth), int)
    for source, to in graph.edges:
        if source == index:
            edge, (at, _) = graph.edges[source, to], graph.predict(source, to)
            seen += (edge.weight > 0) & (np.linalg.norm(at - edge.target.T, axis=1) < pixels)
    good = (seen >= views) & (keyframe.information * keyframe.inverse_depth**2 > relative**-2)
    height, width = keyframe.image.size
    at = (keyframe.points[good].astype(np.float64) + 0.5) / [width, height]
    return Points(at, keyframe.inverse_depth[good], np.flatnonzero(good))


def _without(view: StereoKeyframe, held: np.ndarray) -> StereoKeyframe:
    mask = held.reshape(view.weight.shape)
    weight, inverse_depth = (np.where(mask, 0.0, a).astype(np.float32) for a in (view.weight, view.inverse_depth))
    return replace(view, weight=weight, inverse_depth=inverse_depth)


def _scores(
    name: str, street: Street, found: Run, points: list[Points | None], withheld: list[np.ndarray]
) -> list[Row]:
    kept, ratios, total = [], [], 0
    for fused, known, held in zip(found.fused, points, withheld, strict=True):
        height, width = fused.depth.shape
        first = int(np.ceil(fused.view.intrinsics[3])) if street.below_horizon else 0
        kept.append(fused.depth[first:] > 0)
        if known is None:
            continue
        mine = held[known.cell]
        u, v = np.minimum((known.at[mine] * [width, height]).astype(int), [width - 1, height - 1]).T
        ratio = fused.depth[v, u] * known.inverse_depth[mine]
        total += len(ratio)
        ratios.append(ratio[ratio > 0])
    ratio = np.concatenate(ratios)
    pixels = sum(f.counts["pixels"] for f in found.fused)
    why = [sum(f.counts.get(f"rejected: {reason}", 0.0) for f in found.fused) / pixels for reason in REASONS]
    part = "kept below the horizon" if street.below_horizon else "kept"
    outliers = float(np.mean(np.abs(ratio - 1.0) >= WITHIN)) if len(ratio) else float("nan")
    return [
        at_least(f"{name}, small parallax: {part}", float(np.concatenate(kept).mean()), "", street.kept),
        at_most(f"{name}, small parallax: outliers at verified points", outliers, "", 0.1),
        Row(f"{name}, small parallax: verified points kept", len(ratio) / max(total, 1)),
        Row(f"{name}, small parallax: rejected by {', '.join(REASONS)}", ", ".join(f"{part:.2f}" for part in why)),
    ]
