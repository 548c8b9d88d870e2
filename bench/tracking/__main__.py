"""The tracker's error and its time, sequence by sequence: `python -m bench.tracking`.

ATE is the RMS position error after Sim(3) alignment, of keyframes and of all frames with a pose, each segment apart
(the worst counts). Times are processor time of one thread, so that a busy machine does not change them. On the other
core run COLMAP, on the same frames, and then a long stream whose memory is watched. COLMAP's models are kept for
--resume; all else is measured anew.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.aligned import aligned_error
from bench.pieces import Kept, kept_arguments
from bench.runs import folder
from bench.table import Origin, Row, at_most, main, skipped
from bench.tracking import baselines, curves, loop, memory
from bench.tracking.baselines import Baseline
from bench.tracking.cases import CASES, Case
from bench.tracking.parts import global_adjustment_seconds
from bench.tracking.track import track
from mvsgs_core.datasets import Item
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig
from mvsgs_core.trajectory import TrackingState, Trajectory


@dataclass(frozen=True)
class Result:
    """One run over one sequence. Errors in the unit of the truth (meters), NaN of a segment that has too few frames."""

    path: Trajectory
    keyframe_errors: list[float]  # of each segment
    frame_errors: list[float]
    length: float  # of the true path
    seconds: dict[str, float]  # CPU, by stage
    total: float  # CPU seconds of all `add` calls
    end: float  # CPU seconds of `finish`
    warnings: list[str]

    @property
    def keyframes(self) -> int:
        return int(self.path.keyframe.sum())

    @property
    def unposed(self) -> int:
        return int(np.sum(~np.isfinite(self.path.world_from_cam).all(axis=(1, 2))))

    @property
    def worst(self) -> float:
        """Of the frames' errors the largest; NaN where one is not known, or there is no segment."""
        return worst(self.frame_errors)

    @property
    def worst_of_keyframes(self) -> float:
        return worst(self.keyframe_errors)

    def unknown(self, name: str) -> list[Row]:
        """What must be said of segments that have no error; nothing where all have one."""
        pairs = zip(self.frame_errors, self.keyframe_errors, strict=True)
        count = sum(any(map(math.isnan, pair)) for pair in pairs)
        return [Row(f"{name}: segments without a known error", count)] if count else []


def worst(errors: Sequence[float]) -> float:
    return float(np.max(errors)) if errors else math.nan


def run(items: Sequence[Item], config: TrackerConfig | None = None) -> Result:
    tracked = track(items, Tracker(config, clock=time.process_time))
    path, stats = tracked.tracker.trajectory(), tracked.tracker.stats
    truth = {i.index: i.world_from_cam for i in items if i.world_from_cam is not None}
    segments = sorted({int(s) for s in path.segment if s >= 0})
    known = np.isin(path.index, list(truth)) & np.isfinite(path.world_from_cam).all(axis=(1, 2))
    positions = np.array([pose[:3, 3] for _, pose in sorted(truth.items())])
    return Result(
        path,
        [_ate(path, truth, known & path.keyframe & (path.segment == s)) for s in segments],
        [_ate(path, truth, known & (path.segment == s)) for s in segments],
        float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()) if len(positions) > 1 else 0.0,
        stats.seconds,
        tracked.seconds,
        tracked.end,
        stats.warnings,
    )


def _ate(path: Trajectory, truth: dict[int, np.ndarray], chosen: np.ndarray) -> float:
    if chosen.sum() < 3:
        return float("nan")
    found = path.world_from_cam[chosen, :3, 3]
    wanted = np.stack([truth[int(n)][:3, 3] for n in path.index[chosen]])
    return aligned_error(found, wanted)


def rows_of(name: str, case: Case, results: list[Result]) -> list[Row]:
    first = results[0]
    keyframe = [100.0 * r.worst_of_keyframes for r in results]
    rows = [_ate_row(f"{name}: ATE keyframes", float(np.max(keyframe)), case.goal, first.length)]
    if len(results) > 1:
        rows.append(at_most(f"{name}: spread of {len(results)} runs", float(np.ptp(keyframe)), "cm", 1e-9))
        rows.append(at_most(f"{name}: the same run again, largest difference", _difference(results), "", 0.0))
    rows.append(Row(f"{name}: ATE all frames", 100.0 * first.worst, "cm"))
    rows += first.unknown(name)
    rows.append(Row(f"{name}: keyframes", first.keyframes, f"of {len(first.path.index)}"))
    states = {s.name.lower(): int(np.sum(first.path.state == s)) for s in TrackingState if s != TrackingState.TRACKED}
    if case.hard:
        told = first.unposed == 0 or any("lost" in w or "start" in w for w in first.warnings)
        segments = len(first.keyframe_errors)
        told &= segments <= 1 or any("segments" in w for w in first.warnings)
        wrong = (first.worst if segments else 0.0) / max(first.length, 1e-9)
        rows.append(Row(f"{name}: without a pose", first.unposed, str(states), "reported", bool(told)))
        rows.append(at_most(f"{name}: error over path, {segments} segments", 100.0 * wrong, "%", 4.0))
    else:
        rows.append(at_most(f"{name}: without a pose", first.unposed, "frames", 0))
    frames = max(1, len(first.path.index))
    total = float(np.mean([r.total for r in results])) / frames
    rows.append(at_most(f"{name}: front end, all of it", 1e3 * total, "ms/frame CPU", 40.0))
    adjusting = float(np.mean([r.seconds.get("local bundle adjustment", 0.0) for r in results]))
    local = adjusting / max(1, first.keyframes)
    rows.append(at_most(f"{name}: local bundle adjustment", 1e3 * local, "ms/keyframe CPU", 25.0))
    return rows


def _difference(results: list[Result]) -> float:
    """Largest difference of any entry of any pose between the first run and the others; infinite if frames differ."""
    first = results[0].path
    worst = 0.0
    for other in (r.path for r in results[1:]):
        if not np.array_equal(np.isnan(other.world_from_cam), np.isnan(first.world_from_cam)):
            return float("inf")
        worst = max(worst, float(np.nanmax(np.abs(other.world_from_cam - first.world_from_cam), initial=0.0)))
    return worst


def _ate_row(name: str, centimeters: float, goal: str, length: float) -> Row:
    if not goal:
        return Row(name, centimeters, "cm")
    limit = float(goal[:-1]) * length if goal.endswith("%") else float(goal)
    return at_most(name, centimeters, "cm", limit)


def curve(name: str, items: Sequence[Item], folder: Path) -> list[Row]:
    """Run time against error over the main settings; the plot goes to `folder`."""

    def one(config: TrackerConfig) -> tuple[float, float, int]:
        result = run(items, config)
        milliseconds = 1e3 * result.total / len(items)
        return milliseconds, 100.0 * result.worst_of_keyframes, result.keyframes

    points = curves.measure(one)
    curves.draw(folder / f"{name}.svg", points)
    return curves.rows(name, points)


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    chosen = [n for n, c in CASES.items() if (c.quick or not options.quick) and n in (options.only or CASES)]
    whole = not options.quick
    place, kept = folder(options, "tracking"), Kept(options.resume)
    kept.origins.append(kept.here)  # of our own runs
    rows: list[Row] = []
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as beside:
        solved: dict[str, Future[tuple[Baseline, list[Origin]]]] = {}
        for name in chosen if options.colmap and whole else []:
            if CASES[name].baseline_stride and not CASES[name].hard and CASES[name].there:
                solved[name] = beside.submit(baselines.solve_case, name, place / "colmap", options.resume)
        long = whole and (not options.only or "memory" in options.only)
        long_run = beside.submit(memory.follow, options.frames) if long else None
        for name in chosen:
            rows += rows_of_case(name, CASES[name], options)
        if options.curve and whole:
            for name in curves.SEQUENCES:
                if name in chosen and CASES[name].there:
                    rows += curve(name, CASES[name].items(), place)
        if not options.only:
            rows += parts(options)
        for name, future in solved.items():
            items = CASES[name].items()[:: CASES[name].baseline_stride]
            ours = run(items)
            baseline, origins = future.result()
            kept.origins += origins
            rows += baselines.rows(name, baseline, ours.path, items, ours.total + ours.end)
        if long_run is not None:
            rows += memory.rows(long_run.result())
    return rows + kept.origin()


def rows_of_case(name: str, case: Case, options: argparse.Namespace) -> list[Row]:
    try:
        items = case.items()
    except FileNotFoundError as error:
        return [skipped(name, str(error))]
    return rows_of(name, case, [run(items) for _ in range(1 if options.quick else options.runs)])


def parts(options: argparse.Namespace) -> list[Row]:
    keyframes = 40 if options.quick else 100
    seconds = global_adjustment_seconds(keyframes)
    rows = [at_most(f"global bundle adjustment, {keyframes} keyframes", seconds, "s CPU", 3.0)]
    return rows if options.quick else rows + loop.rows(CASES["room, loop"].items())


def arguments(parser: argparse.ArgumentParser) -> Any:
    flag = argparse.BooleanOptionalAction
    parser.add_argument("--runs", type=int, default=3, help="of every sequence")
    known = [*CASES, "memory"]
    parser.add_argument("--only", nargs="*", choices=known, metavar="NAME", help="sequences, or memory; default: all")
    parser.add_argument("--colmap", action=flag, default=True, help="pycolmap on the same frames (one core, minutes)")
    parser.add_argument("--curve", action=flag, default=True, help="run time against error over the main settings")
    parser.add_argument("--frames", type=int, default=2000, help="of the run whose memory is measured, more than 500")
    kept_arguments(parser)


if __name__ == "__main__":
    main(measure, "tracking", arguments)
