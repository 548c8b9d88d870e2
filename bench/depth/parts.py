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
Figures = dict[str, tuple[float, str]]  # value and unit
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


def variant_rows(title: str, scene: Scene, default: Variant, variants: Mapping[str, Variant], align: bool) -> list[Row]:
    """Each variant's figures, and its changes against the default; "~": not larger than the default's own spread.

    The default runs first, last and in the midst of the variants: what the machine does meanwhile is in its spread.
    """
    turns, found = (0, len(variants) // 2, len(variants)), dict[str, Figures]()
    again: list[Figures] = []
    for done, (variant, (cascade, fusion)) in enumerate([*variants.items(), ("", default)]):
        again += [_figures(scene, run(scene.views, *default), align) for turn in turns if turn == done]
        if variant:
            found[variant] = _figures(scene, run(scene.views, cascade, fusion), align)
    rows, base = [], dict[str, tuple[float, float]]()
    for name, (_, unit) in again[0].items():
        values = [figures[name][0] for figures in again]
        base[name] = float(np.median(values)), float(np.ptp(values) / 2)
        rows.append(Row(f"{title}, {scene.name}: default: {name}", base[name][0], unit, spread=base[name][1] or None))
    for variant, figures in found.items():
        for name, (value, unit) in figures.items():
            change = value - base[name][0]
            text = ("~ " if abs(change) <= base[name][1] and base[name][1] else "") + f"{change:+.3g}"
            rows.append(Row(f"{title}, {scene.name}: {variant}: {name}, change", text, unit))
    return rows


def _figures(scene: Scene, found: Run, align: bool) -> Figures:
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
