"""Run time against error of whole runs, over the main settings one at a time: where the defaults stand.

Each curve changes one setting and leaves the others at their defaults; the plot of a scene shows them all with the
Pareto front (nothing else is both faster and better) and the default. The default runs several times, first, last and
between the curves, so that a machine that gets slower or faster meets both: with the seeds of the points, then with
those one higher, and so on. Half the range is the noise, and what beats it by more than that is named. Times are wall
times from the first frame to the refined map, so they mean something on an idle machine only. Runs are kept by scene
and curve: --resume runs only what is missing.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from bench import pieces, plots
from bench.runs import QUICK, Matrix, Run, Setting, choices, figure, folder, said, stage_seconds
from bench.table import Row, failed, main, names, numbers
from mvsgs_core.evaluation.metrics import at

# The cascade of the core with one stage more: scale, step, hypotheses, radius, p1, p2
_COARSEST = "{scale: 4, step: 0.7, hypotheses: 64, radius: 3, p1: 0.3, p2: 2.0}"
_MIDDLE = "{scale: 2, step: 0.5, hypotheses: 15, radius: 3, p1: 0.1, p2: 0.8}"
_FINE = "{scale: 1, step: 0.35, hypotheses: 11, radius: 3, p1: 0.05, p2: 0.4}"
CURVES: dict[str, dict[str, str]] = {  # parameter: label of each point and its value
    "tracker.area": {"19k": "19200", "38k": "38400"},
    "tracker.local_map.window": {"6": "6", "20": "20"},
    "mvs.area": {"9k": "9600", "19k": "19200"},
    "mvs.neighbors.count": {"2": "2", "6": "6"},
    "mvs.stages": {"3 stages": f"[{_COARSEST},{_MIDDLE},{_FINE}]"},
    "depth_fusion.confidence": {"0.6": "0.6", "0.9": "0.9"},
    "depth_fusion.min_views": {"3": "3"},
    "mapper.iterations": {"15": "15", "60": "60", "120": "120"},  # 15: the default once more
    "mapper.max_pixels": {"9k": "9600", "19k": "19200"},
    "mapper.density_control.max_splats": {"10k": "10000", "20k": "20000"},
}
ERRORS = {  # what a curve is drawn over besides the held-out PSNR: path in the report
    "ATE": "trajectory.ate_percent",
    "depth inliers": "depth.inlier_ratio",
}


@dataclass(frozen=True)
class Point:
    """Runs of one setting: `label` on its `curve`, means; NaN where a figure is missing."""

    curve: str
    label: str
    seconds: float
    psnr: float
    run: Run  # the first of them
    noise: tuple[float, float] = (0.0, 0.0)  # half the range of seconds and psnr over the runs; 0 of a single one

    @property
    def name(self) -> str:
        return self.curve if self.curve == "default" else f"{self.curve} = {self.label}"

    def beats(self, other: Point) -> bool:
        """Better in one by more than the noise of both, and not worse in the other by more than that."""
        # a single run's own noise is unknown: it is taken for as large as the other's
        noise = [own + of_other if own > 0.0 else 2.0 * of_other for own, of_other in zip(self.noise, other.noise)]
        faster, better = other.seconds - self.seconds, self.psnr - other.psnr
        return (faster > noise[0] and better > -noise[1]) or (better > noise[1] and faster > -noise[0])


def settings(curves: dict[str, dict[str, str]]) -> dict[str, list[Setting]]:
    """All points by curve, and the default, as choices for Matrices."""
    found = {"default": [Setting("default")]}
    for curve, points in curves.items():
        found[curve] = [Setting(_name(curve, label), (f"{curve}={value}",)) for label, value in points.items()]
    return found


def matrices_of(
    scene: str, curves: dict[str, dict[str, str]], seeds: list[int], repeats: int, overrides: list[str]
) -> dict[str, Matrix]:
    """What is run of a scene, by the name of its piece and in this order: runs of the default stand first, last and at
    equal steps between the curves."""
    made = settings(curves)
    default = made.pop("default")
    turns = [round(k * len(made) / max(1, repeats - 1)) for k in range(repeats)]  # how many curves go before each
    found: dict[str, Matrix] = {}
    for done, (curve, points) in enumerate([*made.items(), ("", [])]):
        for k in (k for k, turn in enumerate(turns) if turn == done):
            shifted = [seed + k for seed in seeds]
            found[f"{scene}/default/{k}"] = Matrix([scene], seeds=shifted, overrides=overrides, settings=default)
        if points:
            found[f"{scene}/{curve}"] = Matrix([scene], seeds=seeds, overrides=overrides, settings=points)
    return found


def points_of(runs: list[Run], curves: dict[str, dict[str, str]]) -> tuple[Point | None, list[Point]]:
    """The default, None where it did not run, and the others that did; runs of several seeds are averaged."""
    by_setting: dict[str, list[Run]] = {}
    for run in runs:
        by_setting.setdefault(run.setting, []).append(run)

    def point(curve: str, label: str, name: str) -> Point:
        same = by_setting[name]
        (seconds, of_seconds), (psnr, of_psnr) = _mean(same, "time.wall"), _mean(same, "rendering.held_out.psnr")
        return Point(curve, label, seconds, psnr, same[0], (of_seconds, of_psnr))

    names = [(curve, label, _name(curve, label)) for curve, points in curves.items() for label in points]
    others = [point(*names_of) for names_of in names if names_of[2] in by_setting]
    return point("default", "default", "default") if "default" in by_setting else None, others


def rows_of(scene: str, default: Point, others: list[Point]) -> list[Row]:
    everything = [default, *others]
    front = plots.pareto([p.seconds for p in everything], [p.psnr for p in everything])
    rows = []
    for k, point in enumerate(everything):
        name = f"{scene}: {point.curve}" + ("" if point is default else f" {point.label}")
        if point.run.report is None:
            rows.append(failed(name, said(point.run)))
            continue
        rows.append(Row(f"{name}: wall time", point.seconds, "s"))
        rows.append(Row(f"{name}: held-out PSNR", point.psnr, "dB"))
        rows += [Row(f"{name}: {e}", figure(point.run.report, path), at(path).unit) for e, path in ERRORS.items()]
        rows += [Row(f"{name}: {n}", stage_seconds(point.run.report, n), "s") for n in ("tracker", "mvs", "mapper")]
        rows.append(Row(f"{name}: splats", figure(point.run.report, "map.splats")))
        rows.append(Row(f"{name}: on the front", "yes" if k in front else "no"))
    rows.append(Row(f"{scene}: default: half the range of its wall times", default.noise[0], "s"))
    rows.append(Row(f"{scene}: default: half the range of its held-out PSNR", default.noise[1], "dB"))
    beating = [point.name for point in others if point.beats(default)] if any(default.noise) else ["unknown"]
    rows.append(Row(f"{scene}: default: beaten by", ", ".join(beating) or "none"))
    return rows


def _name(curve: str, label: str) -> str:
    return f"{curve}_{label}".replace(".", "_").replace(" ", "_")


def _mean(runs: list[Run], path: str) -> tuple[float, float]:
    """And half the range; NaN and 0 where no run has that figure."""
    values = [v for v in (figure(run.report, path) for run in runs) if v is not None]
    return (float(np.mean(values)), float(np.ptp(values) / 2)) if values else (float("nan"), 0.0)


def measure(options: argparse.Namespace) -> list[Row]:
    overrides, repeats = list(options.overrides), options.repeats
    scenes, rows = pieces.with_data(options.scenes)
    curves = {name: CURVES[name] for name in options.curves}
    if options.quick:
        scenes, curves, repeats = scenes[:1], {"mapper.iterations": {"5": "5"}}, 1
        overrides += QUICK
    made = pieces.Pieces.of(options, folder(options, "curves"))
    matrices: dict[str, Matrix] = {}
    for scene in scenes:
        matrices |= matrices_of(scene, curves, options.seeds, repeats, overrides)
    runs = made.runs(matrices)
    for scene in scenes:
        default, others = points_of([run for run in runs if run.scene == scene], curves)
        if default is None:
            continue
        rows += rows_of(scene, default, others)
        points = [(p.curve, p.label, p.seconds, p.psnr) for p in others]
        at = default.seconds, default.psnr
        axes = ("wall time, s", "held-out PSNR, dB")
        plots.write(made.output / f"{scene}.svg", plots.front_plot(points, at, *axes, noise=default.noise))
    return rows + made.rows()


def arguments(parser: argparse.ArgumentParser) -> None:
    known = choices("scene")
    parser.add_argument("--scenes", type=names(known), default=["room", "redkitchen"], help="comma separated")
    told = f"comma separated; default all: {', '.join(CURVES)}"
    parser.add_argument("--curves", type=names(CURVES), default=list(CURVES), help=told)
    parser.add_argument("--seeds", type=numbers, default=[0], help="comma separated; figures are means over them")
    told = "runs of the default between the curves, each with seeds one higher: the noise"
    parser.add_argument("--repeats", type=int, default=3, help=told)
    pieces.arguments(parser, "dataset.stop=60")


if __name__ == "__main__":
    main(measure, "Run time against error", arguments)
