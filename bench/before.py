"""This checkout against another, such as an earlier commit: the same scenes and settings, in turns, seed by seed.

    git worktree add --detach ../before COMMIT    # and in it `make setup`
    python -m bench.before --other ../before

One run at a time, the mapper with one thread; whatever else the machine does meets both. Figures are those of each
checkout's own report, a scene's parameters are called as the checkout calls them. Where a report has no figure of each
held-out frame, and none of the protocol that fits its camera at test time, the map is scored so here. Without --other
this checkout is compared with itself: what it shows then is noise. --fewer 10:100,5 runs this checkout with so many
iterations a keyframe and at the end, or as many there as the mapper makes of it, too: the best that takes no more of
the mapper's time than before tells what is gained in equal time, the cheapest that is as good as before what the map of
before costs. These are of the first seed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench import pieces
from bench.finished import FinishedRun, frames_of
from bench.runs import (
    FEWER,
    QUICK,
    ROOT,
    Matrix,
    Run,
    choices,
    fewer_iterations,
    figure,
    folder,
    folder_name,
    held_out_scores,
    python,
    said,
)
from bench.table import Row, checked, failed, main, names, numbers

Report = dict[str, Any]
_SMALL_VIDEO = ("dataset.size=[180,240]", "dataset.stop=100")
SCENES: dict[str, tuple[str, ...]] = {  # with what makes them small enough for three seeds of two checkouts
    "redkitchen": _SMALL_VIDEO,
    "tum_fr1_xyz": _SMALL_VIDEO,
    "hololens_000": (),
    "kitti_piece": (),
    "icl_nuim": ("dataset.size=[240,320]",),
    "aerial": (),
    "replica_20": (),
    "room": (),
    "room_exposure": (),
}
GAINS = {  # dB of held-out PSNR that are asked for; of the others that they lose no more than -WORSE
    "redkitchen": 2.5, "tum_fr1_xyz": 2.5, "icl_nuim": 1.0, "hololens_000": 1.0, "kitti_piece": 1.0, "aerial": 1.0,
    "room": 0.3, "replica_20": 0.3, "room_exposure": 6.0,
}  # fmt: skip
WORSE = -0.1
GAP = 1.0  # dB that keyframes may be ahead of held-out frames
SHARE = 0.4  # of the splats and of the mapper's time, at the PSNR of before


@dataclass(frozen=True)
class Figure:
    """One figure of a run; `relative`: its change is a factor, not a difference."""

    table: str
    name: str
    unit: str
    of: Callable[[Report], float | None]
    relative: bool = False

    def change(self, before: float, after: float) -> float:
        return after / before if self.relative else after - before


def _at(path: str) -> Callable[[Report], float | None]:
    return lambda report: figure(report, path)


def _sum(path: str, scale: float = 1.0) -> Callable[[Report], float | None]:
    """Over all nodes but the evaluator, which is no part of the system."""

    def total(report: Report) -> float | None:
        section, _, name = path.partition(".")
        values = (report.get(section) or {}).get(name) or {}
        return scale * float(sum(v for node, v in values.items() if node != "evaluator")) if values else None

    return total


def _gap(report: Report) -> float | None:
    keyframes, held_out = (figure(report, f"rendering.{kind}.psnr") for kind in ("keyframes", "held_out"))
    return None if keyframes is None or held_out is None else keyframes - held_out


def _megabytes(report: Report) -> float | None:
    found = figure(report, "memory.peak_bytes.mapper")
    return None if found is None else 1e-6 * found


PSNR = Figure("Held-out frames", "PSNR", "dB", _at("rendering.held_out.psnr"))
SPLATS = Figure("The map", "splats", "", _at("map.splats"), relative=True)
SECONDS = Figure("Processor time", "mapper", "s", _at("time.cpu.mapper"), relative=True)
AHEAD = Figure("Keyframes", "PSNR ahead of held-out", "dB", _gap)
FIGURES = (
    PSNR,
    Figure("Held-out frames", "SSIM", "", _at("rendering.held_out.ssim")),
    Figure("Held-out frames, camera fitted", "PSNR", "dB", _at("rendering.held_out_fitted.psnr")),
    Figure("Held-out frames, camera fitted", "SSIM", "", _at("rendering.held_out_fitted.ssim")),
    Figure("Held-out frames, by eye", "LPIPS", "", _at("rendering.held_out.lpips")),
    Figure("Held-out frames, by eye", "worst PSNR", "dB", _at("rendering.worst.held_out.psnr")),
    Figure("Keyframes", "PSNR", "dB", _at("rendering.keyframes.psnr")),
    AHEAD,
    SPLATS,
    Figure("The map", "iterations", "", _at("map.iterations"), relative=True),
    SECONDS,
    Figure("Processor time", "all nodes", "s", _sum("time.cpu"), relative=True),
    Figure("Peak memory", "mapper", "MB", _megabytes, relative=True),
    Figure("Peak memory", "all nodes", "MB", _sum("memory.peak_bytes", 1e-6), relative=True),
)


def check(checkout: Path) -> None:
    """Raises ValueError where a checkout would not run its own code."""
    code = "import sys; sys.path.insert(0, sys.argv[1]); import mvsgs_core; print(mvsgs_core.__file__)"
    if not checkout.is_dir():
        raise ValueError(f"{checkout} is no folder")
    command = [python(checkout), "-c", code, str(checkout)]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    found = done.stdout.strip()
    if done.returncode or not Path(found).is_relative_to(checkout):
        what = found or (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise ValueError(f"{checkout} would run {what}: it needs a .venv of its own; `make setup` there")


def checkout_at(text: str) -> Path:
    """Raises ValueError as `check`."""
    found = Path(text).resolve()
    check(found)
    return found


def completed(run: Run) -> Run:
    """With the figure of each held-out frame, and those by the protocol that fits its camera at test time: as the run's
    report has them, or if that of an earlier checkout has not, scored here and kept beside it. Raises ValueError where
    what is scored here is not what the report says."""
    if run.report is None or figure(run.report, "rendering.held_out_fitted.psnr") is not None:
        return run
    file = run.folder / "scored.json"
    if not file.exists():
        found = FinishedRun(run.folder, frames_of(run.folder))
        frames = [{"index": index, "psnr": psnr, "held_out": True} for index, psnr in found.psnr.items()]
        file.write_text(json.dumps({"frames": frames, "held_out_fitted": found.fitted()}))
    return replace(run, report={**run.report, "rendering": {**run.report["rendering"], **json.loads(file.read_text())}})


def of_common_frames(before: Report, after: Report) -> tuple[float, float, int] | None:
    """PSNR before and after over the frames that are held out in both, and how many they are."""
    known = [held_out_scores(report) for report in (before, after)]
    common = sorted(known[0].keys() & known[1].keys())
    if not common:
        return None
    old, new = (float(np.mean([psnr[index] for index in common])) for psnr in known)
    return old, new, len(common)


def rows_of(scene: str, before: Sequence[Run], after: Sequence[Run]) -> list[Row]:
    """Of the seeds that both have: means with half the range, and the change from seed to seed."""
    rows = _common_rows(scene, before, after)
    for shown in FIGURES:
        pairs = list(_pairs(shown, before, after))
        if not pairs:
            continue
        old, new = np.array(pairs, dtype=float).T
        changes = np.array([shown.change(*pair) for pair in pairs])
        name = f"{shown.table}: {scene}: {shown.name}"
        rows += [
            Row(f"{name}, before", float(old.mean()), shown.unit, spread=_spread(old)),
            Row(f"{name}, after", float(new.mean()), shown.unit, *_goal_of_figure(shown, new), spread=_spread(new)),
        ]
        kind, unit = ("times before", "") if shown.relative else ("change", shown.unit)
        goal = _goal_of_change(scene, shown, changes)
        rows.append(Row(f"{name}, {kind}", float(changes.mean()), unit, *goal, spread=_spread(changes)))
    return rows


def _common_rows(scene: str, before: Iterable[Run], after: Iterable[Run]) -> list[Row]:
    known = _common(before, after)
    if not len(known):
        return []
    title = f"Frames that are held out in both: {scene}"
    changes = known[:, 1] - known[:, 0]
    return [
        Row(f"{title}: number", ", ".join(dict.fromkeys(f"{count:.0f}" for count in known[:, 2]))),
        Row(f"{title}: PSNR, before", float(known[:, 0].mean()), "dB", spread=_spread(known[:, 0])),
        Row(f"{title}: PSNR, after", float(known[:, 1].mean()), "dB", spread=_spread(known[:, 1])),
        Row(f"{title}: PSNR, change", float(changes.mean()), "dB", *_goal_of_change(scene, PSNR, changes),
            spread=_spread(changes)),
    ]  # fmt: skip


def _common(before: Iterable[Run], after: Iterable[Run]) -> np.ndarray:
    """(N, 3) of the seeds that both have: as `of_common_frames`."""
    old = {run.seed: run.report for run in before if run.report}
    pairs = [of_common_frames(old[run.seed], run.report) for run in after if run.report and run.seed in old]
    return np.array([pair for pair in pairs if pair is not None], dtype=float).reshape(-1, 3)


def _gains(before: Iterable[Run], after: Iterable[Run]) -> list[float]:
    """dB over the frames that are held out in both, seed by seed."""
    return [new - old for old, new, _ in _common(before, after).tolist()]


def _pairs(shown: Figure, before: Iterable[Run], after: Iterable[Run]) -> Iterable[tuple[float, float]]:
    """The figure before and after, of each seed that has both."""
    old = {run.seed: shown.of(run.report) for run in before if run.report}
    new = {run.seed: shown.of(run.report) for run in after if run.report}
    for seed in sorted(old.keys() & new.keys()):
        first, second = old[seed], new[seed]
        if first is not None and second is not None and (first or not shown.relative):
            yield first, second


def _spread(values: np.ndarray) -> float | None:
    return float(np.ptp(values) / 2) if len(values) > 1 else None


def _goal_of_figure(shown: Figure, values: np.ndarray) -> tuple[str, bool | None]:
    return (f"<= {GAP:g}", bool(values.mean() <= GAP)) if shown is AHEAD else ("", None)


def _goal_of_change(scene: str, shown: Figure, changes: np.ndarray) -> tuple[str, bool | None]:
    """Of time and memory what is no more than the spread above 1 is no more than before."""
    if shown is PSNR:
        wanted = GAINS.get(scene, WORSE)
        return f">= {wanted:g}", bool(changes.mean() >= wanted)
    if shown.table in (SECONDS.table, "Peak memory"):
        return "<= 1", bool(changes.mean() <= 1.0 + (_spread(changes) or 0.0))
    return "", None


def at_equal_quality(scene: str, before: Sequence[Run], candidates: Mapping[str, Sequence[Run]]) -> list[Row]:
    """What the cheapest of the candidates costs whose mean PSNR is that of before, over the frames that are held out in
    both."""
    good: dict[str, tuple[float, float]] = {}
    for name, runs in candidates.items():
        shares = [[shown.change(*pair) for pair in _pairs(shown, before, runs)] for shown in (SECONDS, SPLATS)]
        gains = _gains(before, runs)
        if gains and all(shares) and np.mean(gains) >= 0.0:
            good[name] = float(np.mean(shares[0])), float(np.mean(shares[1]))
    title = f"At before's PSNR: {scene}"
    if not good:
        return [Row(f"{title}: cheapest", "none is as good", "", f"<= {SHARE:g} of before", False)]
    name = min(good, key=lambda n: good[n])
    shares_of = zip(("mapper's processor time, times before", "splats, times before"), good[name])
    return [
        Row(f"{title}: cheapest", name),
        *(Row(f"{title}: {what}", value, "", f"<= {SHARE:g}", value <= SHARE) for what, value in shares_of),
    ]


def at_equal_time(scene: str, before: Sequence[Run], candidates: Mapping[str, Sequence[Run]]) -> list[Row]:
    """What the best of the candidates gains whose mapper takes no more processor time than that of before (by no more
    than the spread over the seeds), over the frames that are held out in both."""
    found: dict[str, tuple[float, float]] = {}
    for name, runs in candidates.items():
        shares = [SECONDS.change(*pair) for pair in _pairs(SECONDS, before, runs)]
        gains = _gains(before, runs)
        if gains and shares and np.mean(shares) <= 1.0 + (_spread(np.array(shares)) or 0.0):
            found[name] = float(np.mean(gains)), float(np.mean(shares))
    title = f"At before's processor time: {scene}"
    wanted = GAINS.get(scene, WORSE)
    if not found:
        return [Row(f"{title}: best", "none takes as little", "", f">= {wanted:g}", False)]
    name = max(found, key=lambda n: found[n])
    gain, share = found[name]
    return [
        Row(f"{title}: best", name),
        Row(f"{title}: mapper's processor time, times before", share),
        Row(f"{title}: PSNR, change", gain, "dB", f">= {wanted:g}", gain >= wanted),
    ]


def sides(other: Path, fewer: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[Path, tuple[str, ...]]]:
    """Checkout and overrides of each kind of run."""
    here = {name: (ROOT, settings) for name, settings in fewer.items()}
    return {"before": (other, ()), "after": (ROOT, ()), **here}


def measure(options: argparse.Namespace) -> list[Row]:
    other, seeds = options.other, options.seeds
    scenes, skipped = pieces.with_data(options.scenes)
    overrides = ["recorder=track", "mapper.threads=1", *options.overrides]
    if options.quick:
        scenes, skipped, seeds = ["room"], [], seeds[:1]
        overrides += QUICK
    check(ROOT)
    output = folder(options, "before")
    made = {checkout: pieces.Pieces.of(options, output, checkout) for checkout in (other, ROOT)}
    runs: dict[str, dict[str, list[Run]]] = {scene: {} for scene in scenes}
    for seed in seeds:
        for scene in scenes:
            for side, (checkout, settings) in sides(other, options.fewer).items():
                if side not in ("before", "after") and seed != seeds[0]:
                    continue
                given = [*SCENES.get(scene, ()), *overrides, *settings]
                matrix = Matrix([scene], seeds=[seed], overrides=given, checkout=checkout)
                found = made[checkout].runs({place(scene, seed, side): matrix})
                runs[scene].setdefault(side, []).extend(found)
    rows = [Row(side, ", ".join(made[path].commits)) for side, path in (("before", other), ("after", ROOT))]
    for scene, by_side in runs.items():
        for side, group in by_side.items():
            for k, run in enumerate(group):
                try:
                    group[k] = completed(run)
                except ValueError as error:
                    rows.append(Row(f"{scene}, {side}, seed {run.seed}: scored here", str(error)))
        rows += rows_of(scene, by_side["before"], by_side["after"])
        if options.fewer:
            candidates = {side: group for side, group in by_side.items() if side != "before"}
            rows += at_equal_time(scene, by_side["before"], candidates)
            rows += at_equal_quality(scene, by_side["before"], candidates)
        rows += [
            failed(f"{scene}, {side}, seed {run.seed}", said(run))
            for side, group in by_side.items()
            for run in group
            if run.report is None
        ]
    of_other = [] if other == ROOT else [replace(row, name=f"before: {row.name}") for row in made[other].rows()]
    return rows + skipped + of_other + made[ROOT].rows()


def place(scene: str, seed: int, side: str) -> str:
    """Folder of a run, in that of the benchmark; its files are in folder 0 in there."""
    return f"{scene}/{seed}/{folder_name(side)}"


def arguments(parser: argparse.ArgumentParser) -> None:
    told = "checkout to compare with, such as a git worktree; default: this one"
    parser.add_argument("--other", type=checked(checkout_at), default=str(ROOT), help=told)
    parser.add_argument("--scenes", type=names(choices("scene")), default=list(SCENES), help="comma separated")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], help="comma separated")
    parser.add_argument("--fewer", type=checked(fewer_iterations), default={}, help=FEWER)
    pieces.arguments(parser, "dataset.stop=60")


if __name__ == "__main__":
    main(measure, "Before and after", arguments)
