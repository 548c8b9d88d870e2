"""What each part of stereo, each filter and each skip gains and costs: one thing changed at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bench.depth.data import Scene
from bench.depth.run import Run, run, score
from bench.table import Row
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig

Variant = tuple[CascadeConfig, FusionConfig]
_COUNTED = ("outside the range", "outside the cells")


def part_variants(area: int) -> dict[str, Variant]:
    """Parts of stereo, and filters."""
    base, fusion = CascadeConfig(area=area), FusionConfig()

    def changed(**values: object) -> Variant:
        return replace(base, **values), fusion  # type: ignore[arg-type]

    return {
        "no adaptive windows": changed(cost=replace(base.cost, contrast=1e6)),
        "4 paths": changed(smoothing=replace(base.smoothing, paths=4)),
        "no membrane": changed(fill=False),
        "no choice at depth edges": changed(depth_edges=None),
        "best 2 views": changed(cost=replace(base.cost, top_k=2)),
        "all 4 views": changed(cost=replace(base.cost, top_k=4)),
        "2 neighbors": (replace(base, neighbors=replace(base.neighbors, count=2)), fusion),
        "no refinement": (base, replace(fusion, refine=False)),
        "no consistency check": (base, replace(fusion, check=False)),
        "3 views that agree, by count alone": (base, replace(fusion, min_views=3, confidence=0.0)),
        "3 views that agree": (base, replace(fusion, min_views=3)),
        "4 maps to check with": (base, replace(fusion, neighbors=4)),
        "round trip": (base, replace(fusion, round_trip=True)),
        "no confidence threshold": (base, replace(fusion, confidence=0.0)),
        "no filter": (base, replace(fusion, confidence=0.0, check=False)),
    }


def skip_variants(area: int) -> dict[str, Variant]:
    """The skips, off one by one where they are on, on where they are off."""
    base, fusion = CascadeConfig(area=area), FusionConfig()

    def skips(**values: object) -> Variant:
        return replace(base, pruning=replace(base.pruning, **values)), fusion  # type: ignore[arg-type]

    return {
        "no skip": skips(outside_range=False, outside_cells=False),
        "all hypotheses, in the cells' range": skips(outside_range=False),
        "hypotheses outside the cells too": skips(outside_cells=False),
    }


def variant_rows(title: str, scene: Scene, default: Run, variants: Mapping[str, Variant], align: bool) -> list[Row]:
    """Each variant's figures, and its changes against the default."""
    base = _figures(scene, default, align)
    rows = [Row(f"{title}, {scene.name}: default: {name}", value, unit) for name, (value, unit) in base.items()]
    for variant, (cascade, fusion) in variants.items():
        found = _figures(scene, run(scene.views, cascade, fusion), align)
        rows += [
            Row(f"{title}, {scene.name}: {variant}: {name}, change", f"{found[name][0] - value:+.3g}", unit)
            for name, (value, unit) in base.items()
        ]
    return rows


def _figures(scene: Scene, found: Run, align: bool) -> dict[str, tuple[float, str]]:
    raw = score([d.result.depth for d in found.stereo], scene, align)
    kept = score([f.depth for f in found.fused], scene, align)
    totals = [sum(d.result.counts.get(what, 0.0) for d in found.stereo) for what in _COUNTED]
    everything = sum(d.result.counts.get("hypotheses", 0.0) for d in found.stereo) + totals[0]
    return {
        "unfiltered error": (raw.relative_error, ""),
        "inliers": (kept.inliers, ""),
        "completeness": (kept.completeness, ""),
        "processor time": (1000 * found.processor_seconds, "ms"),
        "fraction skipped": (float(np.sum(totals) / everything) if everything else 0.0, ""),
    }
