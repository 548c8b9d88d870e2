"""Whole runs over scenes and variants: `python -m bench.scenes --scenes room,tum_fr1_xyz --variants full,A`.

Every run goes through launch/run_all.py, so it measures what a user gets. Scenes and variants are Hydra choices in
bench/conf. Figures of the paper stand beside ours where the scene is the paper's.
"""

from __future__ import annotations

import argparse

import numpy as np

from bench import pieces, plots
from bench.runs import QUICK, Matrix, Run, available_scenes, choices, figure, folder, said
from bench.table import Row, failed, main, names, numbers
from mvsgs_core.evaluation import metrics, svg

COLUMNS = {  # path in the report
    "KF PSNR": "rendering.keyframes.psnr",
    "held-out PSNR": "rendering.held_out.psnr",
    "held-out, fitted": "rendering.held_out_fitted.psnr",
    "all PSNR": "rendering.all.psnr",
    "held-out, unrefined": "rendering_before_refinement.held_out.psnr",
    **{metric.label: f"rendering.held_out.{metric.key}" for metric in metrics.IMAGE[1:]},
    **{metric.label: f"trajectory.{metric.key}" for metric in metrics.TRAJECTORY},
    **{metric.label: f"depth.{metric.key}" for metric in metrics.DEPTH},
    **{metric.label: place for place, metric in metrics.RUN.items() if "*" not in place},
}
PEAK = "peak MB"  # sum over the nodes

# Tables I and II of the paper: PSNR, SSIM, LPIPS as published; which frames were scored is not stated there
PAPER = {
    "replica_office0": (41.02, 0.98, 0.05),
    "replica_office1": (42.04, 0.98, 0.05),
    "replica_office2": (34.00, 0.95, 0.09),
    "replica_office3": (34.65, 0.96, 0.07),
    "replica_office4": (33.33, 0.95, 0.10),
    "replica_room0": (32.20, 0.95, 0.10),
    "replica_room1": (31.54, 0.92, 0.13),
    "replica_room2": (35.84, 0.96, 0.07),
    "tum_desk": (20.67, 0.77, 0.25),
    "tum_xyz": (24.53, 0.86, 0.15),
    "tum_office": (22.37, 0.80, 0.24),
}


def value(run: Run, column: str) -> float | None:
    """A figure of a run in the column's unit."""
    if column == PEAK:
        peaks = (run.report or {}).get("memory", {}).get("peak_bytes", {})
        return 1e-6 * float(sum(peaks.values())) if peaks else None
    found = figure(run.report, COLUMNS[column])
    return None if found is None else found * metrics.at(COLUMNS[column]).factor


def time_against_error(runs: list[Run]) -> str:
    """Held-out PSNR over wall time, one color a variant."""
    series = []
    for variant in dict.fromkeys(r.variant for r in runs):
        points = [(value(r, "wall s"), value(r, "held-out PSNR")) for r in runs if r.variant == variant]
        x, y = np.array([p for p in points if None not in p], dtype=float).reshape(-1, 2).T
        series.append(svg.Series(variant, x, y, points=True))
    return svg.plot(series, "wall time, s", "held-out PSNR, dB", width=900, height=420)


def rows(runs: list[Run]) -> list[Row]:
    """Of each scene and variant the mean over the seeds, with half their range; the paper's figures; failures."""
    found = []
    units = {column: metrics.at(path).unit for column, path in COLUMNS.items()} | {PEAK: "MB"}
    for scene, variant in dict.fromkeys((run.scene, run.variant) for run in runs):
        group = [run for run in runs if (run.scene, run.variant) == (scene, variant)]
        for column, unit in units.items():
            values = [v for v in (value(run, column) for run in group) if v is not None]
            if values:
                spread = (max(values) - min(values)) / 2 if len(values) > 1 else None
                found.append(Row(f"{scene}/{variant}: {column}", float(np.mean(values)), unit, spread=spread))
        found += [
            failed(f"{scene}/{variant}/seed {run.seed}: finished", said(run)) for run in group if run.report is None
        ]
    for scene in dict.fromkeys(run.scene for run in runs if run.scene in PAPER):
        published = zip(("all PSNR", "SSIM", "LPIPS"), PAPER[scene])
        found += [Row(f"{scene}/the paper: {column}", measured, units[column]) for column, measured in published]
    return found


def arguments(parser: argparse.ArgumentParser) -> None:
    known, variants = choices("scene"), choices("variant")
    told = f"comma separated; default: those whose data are here; known: {', '.join(known)}"
    parser.add_argument("--scenes", type=names(known), help=told)
    told = f"comma separated: {', '.join(variants)}"
    parser.add_argument("--variants", type=names(variants), default=["full"], help=told)
    parser.add_argument("--seeds", type=numbers, default=[0], help="comma separated")
    pieces.arguments(parser, "mapper.iterations=30", jobs=True)


def measure(options: argparse.Namespace) -> list[Row]:
    overrides = list(options.overrides)
    if options.quick:
        overrides += QUICK
    scenes, skipped = pieces.with_data(options.scenes or (["room"] if options.quick else available_scenes()))
    parts = {scene: [scene] for scene in scenes} if options.jobs == 1 else {"runs": scenes}  # those at once are one
    made = pieces.Pieces.of(options, folder(options, "scenes"))
    given = options.variants, options.seeds, overrides, options.jobs
    runs = made.runs({name: Matrix(some, *given) for name, some in parts.items() if some})
    plots.write(made.output / "time_against_error.svg", time_against_error(runs))
    return rows(runs) + skipped + made.rows()


if __name__ == "__main__":
    main(measure, "Whole runs", arguments)
