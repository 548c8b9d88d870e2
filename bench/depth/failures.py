"""What goes wrong on purpose, and how much of it the filters let through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bench.depth.data import Scene, load_scene
from bench.depth.run import Run, run, score
from bench.table import Row, at_least, at_most
from mvsgs_core import geometry
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig


def wrong_pose(scene: Scene) -> Scene:
    """One keyframe in the middle stands 15 % of the median depth beside its place and is turned by 2 degrees."""
    middle = len(scene.views) // 2
    truth = scene.truths[middle]
    assert truth is not None
    offset = np.array([0.15 * float(np.median(truth[truth > 0])), 0.0, 0.0, 0.0, np.radians(2.0), 0.0])
    views = list(scene.views)
    views[middle] = replace(views[middle], world_from_cam=views[middle].world_from_cam @ geometry.se3_exp(offset))
    truths = list(scene.truths)
    truths[middle] = None  # its own depth is in a frame of its own
    return replace(scene, views=views, truths=truths)


def exposure_change(scene: Scene) -> Scene:
    """Every other keyframe at 60 % gain and 15 gray levels brighter."""
    views = [
        replace(v, pyramid=tuple((0.6 * (p + 128.0) + 15.0 - 128.0).astype(np.float32) for p in v.pyramid))
        if number % 2 else v
        for number, v in enumerate(scene.views)
    ]  # fmt: skip
    return replace(scene, views=views)


def missed_range(scene: Scene) -> Scene:
    """The tracker's inverse depths are four times too large: nothing of the scene lies in the range."""
    return replace(scene, views=[replace(v, inverse_depth=4.0 * v.inverse_depth) for v in scene.views])


LEAST = 0.75  # of the true depths, kept where stereo has what it needs: a filter that rejects all has no outliers, too
NOTHING = "range misses the scene"  # nothing can be right
FAILURES: dict[str, Callable[[Scene], Scene]] = {
    "wrong pose of one keyframe": wrong_pose,
    "exposure change": exposure_change,
    NOTHING: missed_range,
}


_FILTERS = ("confidence", "consistency")


def failure_rows(area: int, count: int | None) -> list[Row]:
    """Outliers (beyond 5 %) among the kept pixels, and how much each filter rejected."""
    room = load_scene("room", area, count)
    scenes = {name: change(room) for name, change in FAILURES.items()}
    scenes["moving object"] = load_scene("room", area, count, moving_object=1.0)
    scenes["bare walls"] = load_scene("room", area, count, textureless=4)
    rows = []
    for name, scene in scenes.items():
        found = run(scene.views, CascadeConfig(area=area), FusionConfig())
        kept = score([f.depth for f in found.fused], replace(scene, tolerance=0.05))
        outliers = 0.0 if kept.completeness == 0 else 1.0 - kept.inliers
        rows.append(at_most(f"{name}: outliers of kept", outliers, "", 0.05))
        share = Row(f"{name}: kept", kept.completeness)
        rows.append(share if name == NOTHING else at_least(share.name, kept.completeness, "", LEAST))
        rows.append(Row(f"{name}: rejected by {', '.join(_FILTERS)}", _rejected(found)))
    return rows


def _rejected(found: Run) -> str:
    pixels = sum(f.counts["pixels"] for f in found.fused)
    parts = [sum(f.counts.get(f"rejected: {k}", 0.0) for f in found.fused) for k in _FILTERS]
    return ", ".join(f"{p / pixels:.2f}" for p in parts)
