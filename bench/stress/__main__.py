"""Where reconstruction is hard: every stage's error, what the system says itself, and whether a map is kept.

The synthetic room, 90 frames at 240x180, 12 iterations a keyframe and 60 at the end, with one difficulty at a time in
three strengths; hard real sequences; repeated runs; a long run with the memory of every process; one core; a slow node.
A run passes where it keeps a map and, if tracking or map are broken, says so itself: warnings or lost frames.
Runs are kept by difficulty and group: --resume runs only what is missing.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from bench import pieces
from bench.memory import flat_rows, sampled
from bench.runs import Matrix, Run, Setting, figure, folder, said
from bench.table import Row, at_most, main, names

SMALL = (
    "dataset.size=[180,240]", "dataset.stop=90", "tracker.area=43200", "mvs.area=43200",
    "mapper.iterations=12", "mapper.refinement=60", "evaluator.max_frames=30", "evaluator.lpips=off",
)  # fmt: skip
TINY = (
    "dataset.size=[120,160]", "tracker.area=19200", "mvs.area=19200", "mapper.iterations=4", "mapper.refinement=20",
    "evaluator.max_frames=50", "evaluator.lpips=off",
)  # fmt: skip
DIFFICULTIES: dict[str, tuple[float, ...]] = {  # mild, hard, breaking: see mvsgs_core/scene/difficulties.py
    "textureless": (1, 2, 4),
    "pure_rotation": (10, 20, 40),
    "motion_blur": (0.25, 0.5, 1.0),
    "rolling_shutter": (0.25, 0.5, 1.0),
    "exposure": (0.5, 1.0, 2.0),
    "noise": (4, 12, 30),
    "gloss": (0.5, 1.0, 2.0),
    "moving_object": (0.5, 1.0, 2.0),
    "drop": (0.25, 0.5, 0.8),
    "covered": (5, 15, 40),
    "jump": (5, 15, 60),
    "origin": (1e3, 1e6),
    "scale": (1e-3, 1e3),
}
SAME = ("origin", "scale")  # coordinates only: nothing may change
STARTS = {"pure_rotation": 30, "covered": 40, "jump": 50}  # frame at which it begins
REAL = ("tum_fr3_notexture", "aerial_caliterra", "fox", "fountain", "herz_jesu")
GROUPS = ("difficulties", "real", "repeats", "one_core", "slow_node", "long")
BROKEN_ATE, BROKEN_PSNR = 2.0, 6.0  # % of the path; dB below the easy run


@dataclass(frozen=True)
class Outcome:
    """The figures of a run; None where there is none."""

    ate: float | None  # % of the path
    inliers: float | None
    completeness: float | None
    psnr: float | None  # dB, of the frames that `scored` names
    keyframes: float | None
    tracked: float  # fraction of the frames
    segments: float
    splats: float
    wall: float | None  # s
    said: str
    finished: bool  # with a report
    scored: str = "held-out"  # or "keyframes": of photographs, where every one is mapped

    @staticmethod
    def of(run: Run) -> Outcome:
        r = run.report
        frames = figure(r, "trajectory.frames") or 0.0
        scored = "held-out" if figure(r, "rendering.held_out.psnr") is not None else "keyframes"
        return Outcome(
            figure(r, "trajectory.ate_percent"), figure(r, "depth.inlier_ratio"), figure(r, "depth.completeness"),
            figure(r, f"rendering.{scored.replace('-', '_')}.psnr"), figure(r, "trajectory.keyframes"),
            (figure(r, "trajectory.frames_tracked") or 0.0) / frames if frames else 0.0,
            figure(r, "trajectory.segments") or 0.0, figure(r, "map.splats") or 0.0, figure(r, "time.wall"),
            said(run), r is not None, scored,
        )  # fmt: skip

    @property
    def kept_a_map(self) -> bool:
        return self.splats > 0 and self.psnr is not None

    def broken(self, easy: Outcome | None, known_poses: bool = True) -> bool:
        """Poses or map are far from what the easy run gives, or there are none."""
        lost = self.psnr is None or (known_poses and (self.ate is None or self.ate > BROKEN_ATE))
        worse = easy is not None and None not in (easy.psnr, self.psnr) and easy.psnr - self.psnr > BROKEN_PSNR  # type: ignore[operator]
        return lost or worse

    @property
    def reported(self) -> bool:
        """The system says by itself that something is wrong."""
        return self.said != "nothing" or self.tracked < 0.99 or self.segments > 1


def rows_of(
    name: str, outcome: Outcome, easy: Outcome | None, same: bool = False, known_poses: bool = True
) -> list[Row]:
    rows = [
        Row(f"{name}: ATE", outcome.ate, "% of the path"),
        Row(f"{name}: depth inliers", outcome.inliers),
        Row(f"{name}: depth completeness", outcome.completeness),
        Row(f"{name}: {outcome.scored} PSNR", outcome.psnr, "dB"),
        Row(f"{name}: frames tracked", outcome.tracked),
    ]
    if same and easy is not None:
        difference = abs((outcome.psnr or 0.0) - (easy.psnr or 0.0))
        rows.append(at_most(f"{name}: held-out PSNR, difference to the easy run", difference, "dB", 1.0))
    broken = outcome.broken(easy, known_poses)
    verdict = ("broken, " if broken else "holds, ") + ("map kept" if outcome.kept_a_map else "no map")
    passed = outcome.finished and (not broken or outcome.reported)
    rows.append(Row(f"{name}: outcome", verdict, "", "holds, or says that not", passed))
    return rows if outcome.said == "nothing" else [*rows, Row(f"{name}: it said", outcome.said)]


def setting(difficulty: str, strength: float) -> Setting:
    given = [f"dataset.options.{difficulty}={strength:g}"]
    if difficulty in STARTS:
        given.append(f"dataset.options.{difficulty}_start={STARTS[difficulty]}")
    return Setting(f"{difficulty}_{strength:g}".replace("+", ""), tuple(given))


def difficulties(options: argparse.Namespace, overrides: list[str], easy: Outcome) -> list[Row]:
    chosen = {"covered": (20,), "noise": (12,)} if options.quick else DIFFICULTIES
    rows = []
    for name, strengths in chosen.items():
        settings = [setting(name, strength) for strength in strengths]
        matrix = Matrix(["room"], overrides=overrides, jobs=options.jobs, settings=settings)
        for strength, run in zip(strengths, _go(matrix, options, f"difficulties/{name}")):  # none where it is missing
            rows += rows_of(f"{name} {strength:g}", Outcome.of(run), easy, same=name in SAME)
    return rows


def real(options: argparse.Namespace) -> list[Row]:
    scenes, rows = pieces.with_data(REAL)
    matrix = Matrix(scenes, overrides=SMALL[4:], jobs=options.jobs)
    for run in _go(matrix, options, "real") if scenes else []:
        known_poses = figure(run.report, "trajectory.path_length") is not None
        rows += rows_of(run.scene, Outcome.of(run), None, known_poses=known_poses)
    return rows


def repeats(options: argparse.Namespace, overrides: list[str]) -> list[Row]:
    """Five runs, seeds 0 to 4: mean and half the range."""
    runs = [Outcome.of(run) for run in _go(Matrix(["room"], seeds=range(5), overrides=overrides), options, "repeats")]
    if not runs:
        return []
    rows = []
    for name, unit, values in (
        ("held-out PSNR", "dB", [r.psnr for r in runs]),
        ("ATE", "% of the path", [r.ate for r in runs]),
        ("depth inliers", "", [r.inliers for r in runs]),
        ("wall time", "s", [r.wall for r in runs]),
    ):
        known = [v for v in values if v is not None]
        if known:
            rows.append(Row(f"five runs: {name}, mean", sum(known) / len(known), unit))
            rows.append(Row(f"five runs: {name}, half the range", (max(known) - min(known)) / 2, unit))
    finished = sum(r.kept_a_map for r in runs)
    return [*rows, Row("five runs: finished", f"{finished} of {len(runs)}", "", "all", finished == len(runs))]


def one_run(name: str, matrix: Matrix, options: argparse.Namespace, easy: Outcome) -> list[Row]:
    """A run that may be slow but must give what the easy one gives: nothing is lost on the way."""
    runs = _go(matrix, options, name.replace(" ", "_"))
    if not runs:
        return []
    outcome = Outcome.of(runs[0])
    times = (outcome.wall or float("inf")) / (easy.wall or float("nan"))
    difference = abs((outcome.psnr or 0.0) - (easy.psnr or 0.0))
    return [
        Row(f"{name}: wall time, times that of the easy run", times, "x"),
        at_most(f"{name}: held-out PSNR, difference to the easy run", difference, "dB", 1.0),
        Row(f"{name}: keyframes", outcome.keyframes, "", f"{easy.keyframes:g}", outcome.keyframes == easy.keyframes),
    ]


def long_run(options: argparse.Namespace) -> list[Row]:
    """Memory of every process over a long loop through the room."""
    frames = options.frames
    loop = (f"dataset.options.frames={frames}", "dataset.options.loop=true")
    matrix = Matrix(["room"], overrides=[*TINY, *loop])
    runs = options.made.runs({"long": matrix}, sampled)
    if not runs:
        return []
    name = f"{frames} frames"
    return rows_of(name, Outcome.of(runs[0]), None) + flat_rows(name, options.made.output / "long")


def _go(matrix: Matrix, options: argparse.Namespace, name: str) -> list[Run]:
    """Nothing where the piece is missing."""
    found: list[Run] = options.made.runs({name: matrix})
    return found


def measure(options: argparse.Namespace) -> list[Row]:
    groups = ["difficulties"] if options.quick else options.only
    overrides = [*SMALL, *options.overrides]
    if options.quick:
        overrides += ["dataset.stop=70", "mapper.iterations=10", "mapper.refinement=30"]
    options.made = pieces.Pieces.of(options, folder(options, "stress"))
    runs = _go(Matrix(["room"], overrides=overrides), options, "easy")
    if not runs:
        raise SystemExit(f"the easy run, which the others are compared with, is not in {options.made.output}")
    easy = Outcome.of(runs[0])
    rows = rows_of("nothing hard", easy, None)
    if "difficulties" in groups:
        rows += difficulties(options, overrides, easy)
    if "real" in groups:
        rows += real(options)
    if "repeats" in groups:
        rows += repeats(options, overrides)
    if "one_core" in groups:
        pinned = Matrix(["room"], overrides=overrides, prefix=("taskset", "-c", "0"))
        rows += one_run("one core", pinned, options, easy)
    if "slow_node" in groups:
        slow = "depth_fusion._target_=bench.live.slow.SlowFusion"
        rows += one_run("depth fusion 10 times as slow", Matrix(["room"], overrides=[*overrides, slow]), options, easy)
    if "long" in groups:
        rows += long_run(options)
    return rows + options.made.rows()


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"comma separated, of {', '.join(GROUPS)}; default: all"
    parser.add_argument("--only", type=names(GROUPS), default=list(GROUPS), help=told)
    parser.add_argument("--frames", type=int, default=2000, help="of the long run")
    pieces.arguments(parser, "mapper.iterations=10", jobs=True)


if __name__ == "__main__":
    main(measure, "Stress", arguments)
