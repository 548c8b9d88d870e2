"""Run time against error of whole runs, over the main settings one at a time: where the defaults stand.

Each curve changes one setting and leaves the others at their defaults; the plot of a scene shows them all with the
Pareto front (nothing else is both faster and better) and the default. Times are wall times from the first frame to the
refined map, so they mean something on an idle machine only.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench import plots
from bench.runs import Matrix, Run, Setting, figure, folder, stage_seconds
from bench.table import Row, main

# The cascade of the core with one stage more, one less: scale, step, hypotheses, radius, small_jump, large_jump
_COARSE = "{scale: 2, step: 0.7, hypotheses: 128, radius: 3, small_jump: 0.3, large_jump: 2.0}"
_COARSEST = "{scale: 4, step: 0.7, hypotheses: 64, radius: 3, small_jump: 0.3, large_jump: 2.0}"
_MIDDLE = "{scale: 2, step: 0.5, hypotheses: 15, radius: 3, small_jump: 0.1, large_jump: 0.8}"
_FINE = "{scale: 1, step: 0.35, hypotheses: 11, radius: 3, small_jump: 0.05, large_jump: 0.4}"
CURVES: dict[str, dict[str, tuple[str, ...]]] = {  # curve: label of each point and its overrides
    "tracker.area": {f"{a // 1000}k": (f"tracker.area={a}",) for a in (19200, 38400, 153600)},
    "tracker.window": {str(n): (f"tracker.window={n}",) for n in (6, 20)},
    "mvs.area": {f"{a // 1000}k": (f"mvs.area={a}",) for a in (19200, 38400, 153600)},
    "mvs.neighbors": {str(n): (f"mvs.neighbors={n}",) for n in (2, 6)},
    "mvs.stages": {
        "1 stage": (f"mvs.stages=[{_COARSE}]",),
        "3 stages": (f"mvs.stages=[{_COARSEST},{_MIDDLE},{_FINE}]",),
    },
    "depth_fusion.confidence": {f"{c}": (f"depth_fusion.confidence={c}",) for c in (0.4, 0.6, 0.85)},
    "depth_fusion.least_views": {"3": ("depth_fusion.least_views=3",)},
    "mapper.iterations": {str(n): (f"mapper.iterations={n}",) for n in (15, 60, 120, 240)},
    "mapper.max_pixels": {f"{a // 1000}k": (f"mapper.max_pixels={a}",) for a in (9600, 19200, 38400)},
    "mapper.max_splats": {f"{n // 1000}k": (f"mapper.max_splats={n}",) for n in (10000, 20000, 40000)},
}
ERRORS = {  # what a curve is drawn over besides the held-out PSNR: path in the report, unit
    "ATE": ("trajectory.ate_percent", "% of the path"),
    "depth inliers": ("depth.inlier_ratio", ""),
}


@dataclass(frozen=True)
class Point:
    """One run: `label` on its `curve`; NaN where a figure is missing."""

    curve: str
    label: str
    seconds: float
    psnr: float
    run: Run


def settings(curves: dict[str, dict[str, tuple[str, ...]]]) -> list[Setting]:
    """All points and the default, as choices for a Matrix."""
    found = [Setting("default")]
    for curve, points in curves.items():
        found += [Setting(_name(curve, label), overrides) for label, overrides in points.items()]
    return found


def points_of(runs: list[Run], curves: dict[str, dict[str, tuple[str, ...]]]) -> tuple[Point, list[Point]]:
    """The default, and the others; runs of several seeds are averaged."""
    by_setting: dict[str, list[Run]] = {}
    for run in runs:
        by_setting.setdefault(run.setting, []).append(run)

    def point(curve: str, label: str, name: str) -> Point:
        same = by_setting[name]
        return Point(curve, label, _mean(same, "time.wall"), _mean(same, "rendering.held_out.psnr"), same[0])

    others = [point(curve, label, _name(curve, label)) for curve, points in curves.items() for label in points]
    return point("default", "default", "default"), others


def rows_of(scene: str, default: Point, others: list[Point]) -> list[Row]:
    everything = [default, *others]
    front = plots.pareto([p.seconds for p in everything], [p.psnr for p in everything])
    rows = []
    for k, point in enumerate(everything):
        name = f"{scene}: {point.curve}" + ("" if point is default else f" {point.label}")
        if point.run.report is None:
            rows.append(Row(name, "failed", "", "finished", False))
            continue
        rows.append(Row(f"{name}: wall time", point.seconds, "s"))
        rows.append(Row(f"{name}: held-out PSNR", point.psnr, "dB"))
        rows += [Row(f"{name}: {e}", figure(point.run.report, path), unit) for e, (path, unit) in ERRORS.items()]
        rows += [Row(f"{name}: {n}", stage_seconds(point.run.report, n), "s") for n in ("tracker", "mvs", "mapper")]
        rows.append(Row(f"{name}: on the front", "yes" if k in front else "no"))
    return rows


def table(scene: str, default: Point, others: list[Point]) -> str:
    everything = [default, *others]
    front = plots.pareto([p.seconds for p in everything], [p.psnr for p in everything])
    lines = [
        f"**{scene}**", "",
        "| setting | wall s | held-out dB | ATE % | depth inliers | tracker s | MVS s | mapper s | splats | front |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---|",
    ]  # fmt: skip
    for k, point in enumerate(everything):
        report = point.run.report
        times = [stage_seconds(report, node) for node in ("tracker", "mvs", "mapper")]
        values = [
            (point.seconds, 1), (point.psnr, 2), (figure(report, "trajectory.ate_percent"), 2),
            (figure(report, "depth.inlier_ratio"), 3), *((t, 1) for t in times), (figure(report, "map.splats"), 0),
        ]  # fmt: skip
        cells = ["–" if v is None or not np.isfinite(v) else f"{v:.{digits}f}" for v, digits in values]
        name = "**default**" if point is default else f"{point.curve} = {point.label}"
        lines.append("| " + " | ".join([name, *cells, "yes" if k in front else ""]) + " |")
    return "\n".join(lines)


def picture(default: Point, others: list[Point]) -> str:
    """Each curve in the order of its run times, the default on it."""
    series: dict[str, list[tuple[str, float, float]]] = {}
    for point in others:
        series.setdefault(point.curve, [("", default.seconds, default.psnr)]).append(
            (point.label, point.seconds, point.psnr)
        )
    ordered = {curve: sorted(entries, key=lambda entry: entry[1]) for curve, entries in series.items()}
    return plots.front_plot(ordered, (default.seconds, default.psnr), "wall time, s", "held-out PSNR, dB")


def _name(curve: str, label: str) -> str:
    return f"{curve}_{label}".replace(".", "_").replace(" ", "_")


def _mean(runs: list[Run], path: str) -> float:
    values = [v for v in (figure(run.report, path) for run in runs) if v is not None]
    return float(np.mean(values)) if values else float("nan")


def measure(options: argparse.Namespace) -> list[Row]:
    scenes, overrides = options.scenes.split(","), list(options.overrides)
    curves = {name: CURVES[name] for name in (options.curves.split(",") if options.curves else CURVES)}
    if options.quick:
        scenes, curves = scenes[:1], {"mapper.iterations": {"5": ("mapper.iterations=5",)}}
        overrides += ["dataset.stop=30", "mapper.iterations=15", "mapper.refinement=50"]
    matrix = Matrix(
        scenes, seeds=[int(s) for s in options.seeds.split(",")], overrides=overrides, settings=settings(curves)
    )
    output = folder(options, "curves")
    runs = matrix.collect(output) if options.collect else matrix.run(output)
    rows, tables = [], []
    for scene in scenes:
        default, others = points_of([run for run in runs if run.scene == scene], curves)
        rows += rows_of(scene, default, others)
        tables.append(table(scene, default, others))
        plots.write(output / f"{scene}.svg", picture(default, others))
    (output / "table.md").write_text("\n\n".join(tables) + "\n")
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", default="room", help="comma separated")
    parser.add_argument("--curves", help=f"comma separated; default all: {', '.join(CURVES)}")
    parser.add_argument("--seeds", default="0", help="comma separated; figures are means over them")
    parser.add_argument("--output", type=Path, help="folder of the runs; default: in runs")
    parser.add_argument("--collect", action="store_true", help="only read the runs that are in the folder")
    parser.add_argument("overrides", nargs="*", help="of every run: dataset.stop=60")


if __name__ == "__main__":
    main(measure, "Run time against error", arguments)
