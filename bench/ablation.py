"""What each part of the system brings: variants of whole runs against the full system, three seeds, with spread.

A, B, C and D are the paper's Table III (the tracker's coarse depth, + multi-view stereo, + filtering, + the mask of
unexplored pixels, at the paper's 40 dB); the others switch one thing off or over. A figure is the variant's minus the
full system's: mean over the seeds, plus or minus half the range; "~" stands before one that is not larger than the
spreads of both.

The runs are kept by scene and variant: with --resume the same command, or one with other --variants, runs only what is
missing, so that the whole can be made in pieces (--minutes, --variants) and then stands in one table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench import pieces
from bench.runs import QUICK, Matrix, Run, choices, figure, folder, said
from bench.table import Row, failed, main, names, numbers
from mvsgs_core.evaluation.metrics import at

SCENES = ("room", "tum_fr1_xyz", "redkitchen", "room_exposure")
TABLE_III = ("A", "B", "C", "D")
SKIPS = (  # what is left out, switched off or over; keyframe reuse needs more keyframes than these scenes have
    "no_skips", "no_skip_converged", "no_selective", "no_unexplored",
    "no_price", "whole_error", "only_empty", "no_doubtful", "realtime", "no_skip_cells", "every_frame",
)  # fmt: skip
OTHERS = (
    "no_density_control", "exact", "ges_scale", "ges_loss", "harmonics", "no_exposure", "no_frames_between",
    "refine_poses", "global_shutter", "no_rectification", "true_poses",
)  # fmt: skip
FIGURES = {  # path in the report
    "held-out PSNR": "rendering.held_out.psnr",
    "held-out SSIM": "rendering.held_out.ssim",
    "keyframe PSNR": "rendering.keyframes.psnr",
    "depth inliers": "depth.inlier_ratio",
    "completeness": "depth.completeness",
    "splats": "map.splats",
    "mapper's processor time": "time.cpu.mapper",
    "stereo's": "time.cpu.mvs",
    "tracker's": "time.cpu.tracker",
    "wall time": "time.wall",
}


@dataclass(frozen=True)
class Difference:
    """Variant minus full."""

    mean: float
    spread: float  # half the range of the variant over the seeds
    noise: float  # the same of the full system
    runs: int  # of the one that has fewer; a single run has no known spread

    @property
    def real(self) -> bool:
        return self.runs > 1 and abs(self.mean) > self.spread + self.noise

    def text(self, digits: int) -> str:
        return f"{self.mean:+.{digits}f}" + (f" ± {self.spread:.{digits}f}" if self.runs > 1 else "")


def difference(variant: Sequence[Run], full: Sequence[Run], path: str) -> Difference | None:
    """None where one of them has no such figure."""
    values = [v for v in (figure(run.report, path) for run in variant) if v is not None]
    base = [v for v in (figure(run.report, path) for run in full) if v is not None]
    if not values or not base:
        return None
    return Difference(
        float(np.mean(values) - np.mean(base)),
        float(np.ptp(values) / 2),
        float(np.ptp(base) / 2),
        min(len(values), len(base)),
    )


def select(runs: list[Run], scene: str, variant: str) -> list[Run]:
    return [run for run in runs if (run.scene, run.variant) == (scene, variant)]


def rows_of(runs: list[Run], scenes: Sequence[str], variants: Sequence[str]) -> list[Row]:
    rows = []
    for scene in scenes:
        full = select(runs, scene, "full")
        for name, path in FIGURES.items():
            base = [v for v in (figure(run.report, path) for run in full) if v is not None]
            if base:
                spread = float(np.ptp(base) / 2) if len(base) > 1 else None
                rows.append(Row(f"{scene}: full: {name}", float(np.mean(base)), at(path).unit, spread=spread))
        for variant in variants:
            for name, path in FIGURES.items():
                found = difference(select(runs, scene, variant), full, path)
                if found is not None:
                    real = "" if found.real else "~ " if found.runs > 1 else "once: "
                    rows.append(
                        Row(f"{scene}: {variant}: {name}, change", real + found.text(at(path).digits), at(path).unit)
                    )
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    variants, seeds, overrides = [v for v in options.variants if v != "full"], options.seeds, list(options.overrides)
    scenes, skipped = pieces.with_data(options.scenes)
    if options.quick:
        scenes, variants, seeds = scenes[:1], variants[:1], seeds[:1]
        overrides += QUICK
    made = pieces.Pieces.of(options, folder(options, "ablation"))
    matrices = {
        f"{scene}/{variant}": Matrix([scene], [variant], seeds, overrides, options.jobs)
        for variant in ["full", *variants]
        for scene in scenes
    }
    runs = made.runs(matrices)
    broken = [failed(f"{r.scene}/{r.variant}/seed {r.seed}", said(r)) for r in runs if r.report is None]
    return rows_of(runs, scenes, variants) + broken + skipped + made.rows()


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", type=names(choices("scene")), default=SCENES, help="comma separated")
    every = [*TABLE_III, *SKIPS, *OTHERS]
    parser.add_argument("--variants", type=names(choices("variant")), default=every, help="comma separated")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], help="comma separated")
    pieces.arguments(parser, "dataset.stop=100", jobs=True)


if __name__ == "__main__":
    main(measure, "Ablation", arguments)
