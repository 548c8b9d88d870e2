"""Depth: inliers, completeness and time of stereo and fusion; `python -m bench.depth [--quick] [--json FILE]`.

Inliers: kept pixels within 2 % (synthetic) or 5 % (real) of the true depth. Completeness: kept part of the pixels with
true depth. Kinect depth is a noisy sensor's, without values at edges and on shiny or far surfaces: these pixels are not
scored. "tracked": poses, scale and range are the tracker's, and each map is scaled by its median ratio to the truth.
With true poses the range comes from coarse depth made from the truth with holes, noise and outliers (depth_data.py).
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from bench.depth_data import SHARED, SOURCES, Scene, load_scene
from bench.depth_failures import failure_rows
from bench.depth_peers import plane_sweep, sgbm
from bench.depth_run import Run, Score, run, score
from bench.depth_tracked import load_tracked
from bench.table import Row, at_least, at_most, main
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig
from mvsgs_core.mvs.stereo import StereoConfig

GOALS = {"room": (0.97, 0.75), "redkitchen": (0.90, 0.55), "fr1_xyz": (0.90, 0.55)}  # inliers, completeness
SMALL, LARGE = 320 * 240, 512 * 384


def measure(options: argparse.Namespace) -> list[Row]:
    count = 7 if options.quick else None
    names = ["room"] if options.quick else list(SOURCES)
    rows: list[Row] = []
    for name in names:
        if SOURCES[name].folder and not (SHARED / SOURCES[name].folder).exists():
            rows.append(Row(f"{name}: skipped, {SHARED / SOURCES[name].folder} is missing", None))
            continue
        scene = load_scene(name, SMALL, count)
        found = run(scene.views, CascadeConfig(area=SMALL), FusionConfig())
        rows += quality_rows(scene, found)
        if name in ("room", "redkitchen"):
            rows += peer_rows(scene, found)
    if not options.quick:
        for name in ("redkitchen", "fr1_xyz"):
            if (SHARED / SOURCES[name].folder).exists():
                scene = load_tracked(name, SMALL)
                rows += quality_rows(scene, run(scene.views, CascadeConfig(area=SMALL), FusionConfig()), align=True)
        rows += ablation_rows("room")
    rows += time_rows(options.quick)
    return rows + failure_rows(SMALL, count)


def quality_rows(scene: Scene, found: Run, align: bool = False) -> list[Row]:
    """Unfiltered and filtered depth of one scene."""
    raw = score([d.result.depth for d in found.stereo], scene, align)
    kept = score([f.depth for f in found.fused], scene, align)
    least_inliers, least_completeness = GOALS.get(scene.name, (None, None))
    rows = [_inliers(f"{scene.name}: unfiltered inliers", raw)]
    if scene.name == "redkitchen":
        rows.append(at_most(f"{scene.name}: unfiltered relative error", raw.relative_error, "", 0.10))
    else:
        rows.append(Row(f"{scene.name}: unfiltered relative error", raw.relative_error))
    if least_inliers is None or least_completeness is None:
        rows += [_inliers(f"{scene.name}: inliers", kept), Row(f"{scene.name}: completeness", kept.completeness)]
    else:
        rows.append(at_least(f"{scene.name}: inliers", kept.inliers, "", least_inliers))
        rows.append(at_least(f"{scene.name}: completeness", kept.completeness, "", least_completeness))
    return rows


def _inliers(name: str, value: Score) -> Row:
    return Row(name, value.inliers, "")


def peer_rows(scene: Scene, found: Run) -> list[Row]:
    """Outliers at equal completeness against a plain plane sweep; both figures against SGBM."""
    by_index = {v.index: v for v in scene.views}
    plain: list[np.ndarray] = []
    unsure: list[np.ndarray] = []
    pair: list[np.ndarray] = []
    for one in found.stereo:
        if one.search is None or not one.neighbors:
            empty = np.zeros(one.view.size, np.float32)
            for maps in (plain, unsure, pair):
                maps.append(empty)
            continue
        neighbors = [by_index[i] for i in one.neighbors]
        depth, confidence = plane_sweep(one.view, neighbors, one.search, hypotheses=96)
        plain.append(depth)
        unsure.append(confidence)
        pair.append(sgbm(one.view, neighbors[0], one.search))
    ours = score([f.depth for f in found.fused], scene)
    stereo_only = [np.where(d.result.confidence >= 0.7, d.result.depth, 0).astype(np.float32) for d in found.stereo]
    alone = score(stereo_only, scene)
    known = [(t > 0) if t is not None else np.zeros_like(d, bool) for t, d in zip(scene.truths, plain, strict=True)]
    pooled = np.concatenate([c[k] for c, k in zip(unsure, known, strict=True)])
    rows = []
    for name, reference in (("filtered", ours), ("stereo alone, confidence 0.7", alone)):
        limit = np.quantile(pooled, 1.0 - reference.completeness)
        cut = [np.where(c >= limit, d, 0).astype(np.float32) for c, d in zip(unsure, plain, strict=True)]
        swept = score(cut, scene)
        ratio = (1.0 - swept.inliers) / max(1.0 - reference.inliers, 1e-6)
        rows.append(Row(f"{scene.name}: plane sweep inliers at completeness {swept.completeness:.2f}", swept.inliers))
        rows.append(at_least(f"{scene.name}: outliers of the plane sweep over ours, {name}", ratio, "", 2.0))
    pairwise = score(pair, scene)
    rows.append(Row(f"{scene.name}: SGBM inliers", pairwise.inliers))
    rows.append(Row(f"{scene.name}: SGBM completeness", pairwise.completeness))
    better = alone.inliers > pairwise.inliers and alone.completeness > pairwise.completeness
    text = f"{alone.inliers:.3f}, {alone.completeness:.3f}"
    rows.append(Row(f"{scene.name}: stereo alone, inliers and completeness", text, "", "better than SGBM", better))
    return rows


def ablation_rows(name: str) -> list[Row]:
    """What each part of stereo and each filter gains and costs, on one scene."""
    scene = load_scene(name, SMALL)
    base, fusion = CascadeConfig(area=SMALL), FusionConfig()
    stereo = StereoConfig()
    variants: dict[str, tuple[CascadeConfig, FusionConfig]] = {
        "default": (base, fusion),
        "no adaptive windows": (replace(base, stereo=replace(stereo, contrast=1e6)), fusion),
        "4 paths": (replace(base, stereo=replace(stereo, paths=4)), fusion),
        "first stage only": (replace(base, stereo=replace(stereo, stages=stereo.stages[:1])), fusion),
        "no membrane": (replace(base, stereo=replace(stereo, fill=False)), fusion),
        "best 2 views": (replace(base, stereo=replace(stereo, best_views=2)), fusion),
        "best 4 views": (replace(base, stereo=replace(stereo, best_views=4)), fusion),
        "2 neighbors": (replace(base, neighbors=replace(base.neighbors, count=2)), fusion),
        "no refinement": (base, replace(fusion, refine=False)),
        "no consistency check": (base, replace(fusion, check=False)),
        "round trip": (base, replace(fusion, round_trip=True)),
        "no confidence threshold": (base, replace(fusion, confidence=0.0)),
    }
    rows = []
    for variant, (cascade, filters) in variants.items():
        if variant == "first stage only":  # its maps are half as large: enlarged truth is not, so score at their size
            scene_used = load_scene(name, SMALL // 4, scales=(1, 2, 4))
            half = replace(stereo.stages[0], scale=1)
            cascade = replace(cascade, area=SMALL // 4, stereo=replace(stereo, stages=(half,)))
        else:
            scene_used = scene
        found = run(scene_used.views, cascade, filters)
        kept = score([f.depth for f in found.fused], scene_used)
        text = f"{kept.inliers:.3f}, {kept.completeness:.3f}, {1000 * found.stereo_seconds:.0f} + " \
               f"{1000 * found.fusion_seconds:.0f} ms"  # fmt: skip
        rows.append(Row(f"{name}, {variant}: inliers, completeness, time", text))
    return rows


def time_rows(quick: bool) -> list[Row]:
    """Median time of a keyframe, with all threads that OpenMP has."""
    rows = []
    for area, limits in ((SMALL, (350, 80)), (LARGE, (900, 200))):
        scene = load_scene("room", area, 7 if quick else 10)
        found = run(scene.views, CascadeConfig(area=area), FusionConfig())
        height, width = scene.views[0].size
        rows.append(at_most(f"stereo at {width}x{height}", 1000 * found.stereo_seconds, "ms", limits[0]))
        rows.append(at_most(f"fusion at {width}x{height}", 1000 * found.fusion_seconds, "ms", limits[1]))
    return rows


if __name__ == "__main__":
    main(measure, "Depth: multi-view stereo and fusion")
