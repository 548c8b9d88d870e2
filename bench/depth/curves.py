"""Run time of depth against its error over size, views, hypotheses and stages, the default on the plots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from bench import plots
from bench.depth.data import Scene
from bench.depth.run import run, score
from bench.table import Row
from mvsgs_core.fusion.fusion import FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig
from mvsgs_core.mvs.stereo import Stage

SCALES = (1, 2, 4, 8)
AREAS = {"160x120": 160 * 120, "240x176": 240 * 176, "512x384": 512 * 384}
Loader = Callable[[int, tuple[int, ...]], Scene]  # area, scales


@dataclass(frozen=True)
class Point:
    curve: str
    label: str
    seconds: float  # processor, a keyframe
    inliers: float
    completeness: float

    @property
    def right(self) -> float:
        """Part of the true depth that is kept and right."""
        return self.inliers * self.completeness

    def beats(self, other: Point) -> bool:
        """No worse in anything, better in something."""
        ours, theirs = ((-p.seconds, p.inliers, p.completeness) for p in (self, other))
        return all(a >= b for a, b in zip(ours, theirs, strict=True)) and ours != theirs


def settings(area: int) -> dict[str, dict[str, CascadeConfig]]:
    """Curve -> label -> configuration; all else at its default."""
    base = CascadeConfig(area=area)
    first = base.stages[0]
    coarse = Stage(4, first.step, 64, first.radius, first.p1, first.p2)
    coarsest = replace(coarse, scale=8, hypotheses=32)
    middle = Stage(2, 0.5, 15, first.radius, 0.1, 0.8)
    between = replace(middle, scale=4)

    def staged(*stages: Stage) -> CascadeConfig:
        return replace(base, stages=stages)

    def stepped(step: float) -> CascadeConfig:
        most_hypotheses = round(first.hypotheses * first.step / step)
        return staged(replace(first, step=step, hypotheses=most_hypotheses), *base.stages[1:])

    return {
        "size": {label: replace(base, area=a) for label, a in AREAS.items()},
        "views": {str(n): replace(base, neighbors=replace(base.neighbors, count=n)) for n in (2, 3, 6)},
        "first step, pixels": {str(step): stepped(step) for step in (0.35, 1.0, 1.4)},
        "later hypotheses": {
            str(n): staged(first, *(replace(s, hypotheses=n) for s in base.stages[1:])) for n in (5, 7, 17)
        },
        "stages": {
            "1": staged(replace(first, scale=1)),
            "3": staged(coarse, middle, *base.stages[1:]),
            "4": staged(coarsest, between, middle, *base.stages[1:]),
        },
    }


def curve_rows(load: Loader, area: int, align: bool, quick: bool, output: Path) -> list[Row]:
    curves = settings(area)
    if quick:
        curves = {"later hypotheses": curves["later hypotheses"]}
    name = load(area, SCALES).name
    default = _point(load, "default", "default", CascadeConfig(area=area), align)
    points = [default]
    points += [_point(load, c, label, cascade, align) for c, made in curves.items() for label, cascade in made.items()]
    rows = []
    for point in points:
        beaten = [f"{p.curve} {p.label}" for p in points if p.beats(point)]
        title = f"curves, {name}, {point.curve}" + ("" if point is default else f" {point.label}")
        text = f"{1000 * point.seconds:.0f} ms, {point.inliers:.3f}, {point.completeness:.3f}"
        rows.append(Row(f"{title}: processor, inliers, completeness", text))
        where = "beaten by " + "; ".join(beaten) if beaten else "on the front"
        met = not beaten if point is default else None
        rows.append(Row(f"{title}: front", where, "", "on the front" if point is default else "", met))
    drawn = [(p.curve, p.label, p.seconds, p.right) for p in points[1:]]
    axes = ("processor seconds a keyframe", "kept and right, part of the true depth")
    plot = plots.front_plot(drawn, (default.seconds, default.right), *axes)
    plots.write(output / f"{name.replace(', ', '_')}.svg", plot)
    return rows


def _point(load: Loader, curve: str, label: str, cascade: CascadeConfig, align: bool) -> Point:
    scene = load(cascade.area, SCALES)
    found = run(scene.views, cascade, FusionConfig())
    kept = score([f.depth for f in found.fused], scene, align)
    return Point(curve, label, found.processor_seconds, kept.inliers, kept.completeness)
