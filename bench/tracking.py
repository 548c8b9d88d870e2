"""The tracker's error and its time, sequence by sequence: `python -m bench.tracking`.

ATE is the RMS position error after Sim(3) alignment, of keyframes and of all frames with a pose, each segment apart
(the worst counts). Times are CPU time of one thread, so that a busy machine does not change them.
--runs 3 repeats every sequence; --colmap runs pycolmap on the same frames; --curve the settings on two sequences.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File
from typing import Any

import cv2
import numpy as np

from bench.table import Row, at_least, at_most, main
from bench.tracking_cases import CASES, Case
from bench.tracking_parts import global_adjustment_seconds, loop_with_drift
from mvsgs_core import geometry
from mvsgs_core.datasets import Item
from mvsgs_core.tracking.frames import Path, State
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig


@dataclass(frozen=True)
class Result:
    """One run over one sequence. Errors in the unit of the truth (meters)."""

    path: Path
    keyframe_errors: list[float]  # of each segment
    frame_errors: list[float]
    length: float  # of the true path
    seconds: dict[str, float]  # CPU, by stage
    total: float  # CPU seconds of all `add` calls
    warnings: list[str]

    @property
    def keyframes(self) -> int:
        return int(self.path.keyframe.sum())

    @property
    def unposed(self) -> int:
        return int(np.sum(~np.isfinite(self.path.world_from_cam).all(axis=(1, 2))))


def run(items: Sequence[Item], config: TrackerConfig | None = None) -> Result:
    tracker = Tracker(config, clock=time.process_time)
    start = time.process_time()
    for item in items:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    total = time.process_time() - start
    for _ in tracker.finish():
        pass
    path = tracker.path()
    truth = {i.index: i.world_from_cam for i in items if i.world_from_cam is not None}
    segments = sorted({int(s) for s in path.segment if s >= 0})
    known = np.isin(path.index, list(truth)) & np.isfinite(path.world_from_cam).all(axis=(1, 2))
    positions = np.array([pose[:3, 3] for _, pose in sorted(truth.items())])
    return Result(
        path,
        [_ate(path, truth, known & path.keyframe & (path.segment == s)) for s in segments],
        [_ate(path, truth, known & (path.segment == s)) for s in segments],
        float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()) if len(positions) > 1 else 0.0,
        tracker.stats.seconds,
        total,
        tracker.stats.warnings,
    )


def _ate(path: Path, truth: dict[int, np.ndarray], chosen: np.ndarray) -> float:
    if chosen.sum() < 3:
        return float("nan")
    found = path.world_from_cam[chosen, :3, 3]
    wanted = np.stack([truth[int(n)][:3, 3] for n in path.index[chosen]])
    s, r, t = geometry.umeyama(found, wanted)
    return float(np.sqrt(np.mean(np.sum(np.square(s * found @ r.T + t - wanted), axis=1))))


def rows_of(name: str, case: Case, results: list[Result]) -> list[Row]:
    first = results[0]
    keyframe = [100.0 * max(r.keyframe_errors, default=float("nan")) for r in results]
    rows = [_ate_row(f"{name}: ATE keyframes", float(np.max(keyframe)), case.goal, first.length)]
    if len(results) > 1:
        rows.append(at_most(f"{name}: spread of {len(results)} runs", float(np.ptp(keyframe)), "cm", 1e-9))
    rows.append(Row(f"{name}: ATE all frames", 100.0 * max(first.frame_errors, default=float("nan")), "cm"))
    rows.append(Row(f"{name}: keyframes", first.keyframes, f"of {len(first.path.index)}"))
    states = {s.name.lower(): int(np.sum(first.path.state == s)) for s in State if s != State.TRACKED}
    if case.hard:
        told = first.unposed == 0 or any("lost" in w or "start" in w for w in first.warnings)
        segments = len(first.keyframe_errors)
        told &= segments <= 1 or any("segments" in w for w in first.warnings)
        wrong = max([*first.frame_errors, 0.0]) / max(first.length, 1e-9)
        rows.append(Row(f"{name}: without a pose", first.unposed, str(states), "reported", bool(told)))
        rows.append(at_most(f"{name}: error over path, {segments} segments", 100.0 * wrong, "%", 4.0))
    else:
        rows.append(at_most(f"{name}: without a pose", first.unposed, "frames", 0))
    frames = max(1, len(first.path.index))
    goal = 40.0
    rows.append(at_most(f"{name}: front end, all of it", 1e3 * first.total / frames, "ms/frame CPU", goal))
    local = first.seconds.get("local bundle adjustment", 0.0) / max(1, first.keyframes)
    rows.append(at_most(f"{name}: local bundle adjustment", 1e3 * local, "ms/keyframe CPU", 25.0))
    return rows


def _ate_row(name: str, centimeters: float, goal: str, length: float) -> Row:
    if not goal:
        return Row(name, centimeters, "cm")
    limit = float(goal[:-1]) * length if goal.endswith("%") else float(goal)
    return at_most(name, centimeters, "cm", limit)


def colmap_row(name: str, items: Sequence[Item], ours: Result) -> Row:
    """pycolmap on the same frames at the tracker's size; the error of both over the frames that it registered."""
    from bench.colmap_poses import reconstruct
    from mvsgs_core.camera import fit_size, resize_image, scale_intrinsics

    size = items[0].image.shape[0], items[0].image.shape[1]
    small = fit_size(*size, 512 * 384)
    frames = {i.index: resize_image(i.image, small) for i in items}
    with tempfile.TemporaryDirectory() as folder:
        model, why = reconstruct(frames, scale_intrinsics(items[0].intrinsics, size, small), File(folder), 1)
    if model is None:
        return Row(f"{name}: pycolmap", why)
    truth = {i.index: i.world_from_cam for i in items if i.world_from_cam is not None}
    found = {int(n): pose for n, pose in zip(model.index, model.world_from_cam) if int(n) in truth}
    mine = dict(zip(ours.path.index.tolist(), ours.path.world_from_cam))
    both = [n for n in found if np.isfinite(mine[n]).all()]
    errors = []
    for poses in (found, mine):
        at = np.stack([poses[n][:3, 3] for n in both])
        to = np.stack([truth[n][:3, 3] for n in both])
        s, r, t = geometry.umeyama(at, to)
        errors.append(float(np.sqrt(np.mean(np.sum(np.square(s * at @ r.T + t - to), axis=1)))))
    text = f"times pycolmap's {100 * errors[0]:.2f} cm ({len(found)} of {len(items)} frames)"
    return at_most(f"{name}: our ATE, same frames", errors[1] / errors[0], text, 1.2)


def curve(names: Sequence[str]) -> list[Row]:
    """Run time against error over the main settings, one changed at a time."""
    base = TrackerConfig()
    settings: dict[str, TrackerConfig] = {
        "default": base,
        "area 192x144": replace(base, area=192 * 144),
        "area 512x384": replace(base, area=512 * 384),
        "keyframe flow 0.035": replace(base, front_end=replace(base.front_end, keyframe_flow=0.035)),
        "keyframe flow 0.08": replace(base, front_end=replace(base.front_end, keyframe_flow=0.08)),
        "window 6": replace(base, local_map=replace(base.local_map, window=6)),
        "window 20": replace(base, local_map=replace(base.local_map, window=20)),
        "1 recent, no proximity": replace(base, local_map=replace(base.local_map, recent=1, proximity=0)),
        "6 recent, 6 proximity": replace(base, local_map=replace(base.local_map, recent=6, proximity=6)),
        "2 steps": replace(base, local_map=replace(base.local_map, steps=2)),
        "10 steps": replace(base, local_map=replace(base.local_map, steps=10)),
        "no loops": replace(base, loops=False),
        "flow dis": replace(base, flow="dis"),
    }
    rows = []
    for name in names:
        items = CASES[name].items()
        for label, config in settings.items():
            result = run(items, config)
            error = 100.0 * max(result.keyframe_errors, default=float("nan"))
            speed = f"cm at {1e3 * result.total / len(items):.1f} ms/frame CPU, {result.keyframes} keyframes"
            rows.append(Row(f"{name}, {label}", error, speed))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    rows: list[Row] = []
    for name, case in CASES.items():
        if (options.quick and not case.quick) or (options.only and name not in options.only):
            continue
        try:
            items = case.items()
        except FileNotFoundError as error:
            rows.append(Row(f"{name}: skipped", str(error)))
            continue
        results = [run(items) for _ in range(1 if options.quick else options.runs)]
        rows += rows_of(name, case, results)
        if options.colmap and not case.hard:
            rows.append(colmap_row(name, items, results[0]))
    if not options.only:
        seconds = global_adjustment_seconds(40 if options.quick else 100)
        rows.append(at_most("global bundle adjustment, 100 keyframes", seconds, "s CPU", 3.0))
        if not options.quick:
            before, after = loop_with_drift(CASES["room, loop"].items())
            rows.append(Row("loop with 25 % drift of scale: ATE before", 100.0 * before, "cm"))
            rows.append(at_least("loop with 25 % drift of scale: before / after", before / after, "", 3.0))
    if options.curve:
        rows += curve([n for n in ("tum_fr1_xyz", "room") if not options.only or n in options.only])
    return rows


def arguments(parser: argparse.ArgumentParser) -> Any:
    parser.add_argument("--runs", type=int, default=3, help="of every sequence")
    parser.add_argument("--only", nargs="*", help="names of sequences")
    parser.add_argument("--colmap", action="store_true", help="pycolmap beside it (minutes a sequence)")
    parser.add_argument("--curve", action="store_true", help="run time against error over the main settings")


if __name__ == "__main__":
    main(measure, "tracking", arguments)
