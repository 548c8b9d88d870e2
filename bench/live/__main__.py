"""Real time: sequences played at their own pace on two cores, 320x240: `python -m bench.live`.

Each is first mapped without hurry, then live: with the governor, on one core, with each stage slowed by ten, with each
effort of stereo alone (the best of these is the best fixed setting), and without each. PSNR is that of the held-out
frames that both runs know a pose of. The live map before its refinement is that of two seconds after the last
keyframe. From there on it gets, of the iterations for which there was no time, at most 400, and a refinement of 25
iterations a keyframe, or where these are more, of 6 an image, frames between keyframes included, at most of 1000. The
unhurried map gets 25 a keyframe, however many.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.live.recordings import SCENES, available, recording
from bench.pieces import Kept, kept_arguments
from bench.runs import ROOT, environment, figure, folder, folder_name, held_out_scores, launcher
from bench.table import Row, at_least, at_most, failed, main, names, skipped
from mvsgs_core.mvs.cascade import Cascade

ALL = tuple(range(len(Cascade.efforts)))
ALWAYS = (
    "dataset=player", "device=cpu", "evaluator.lpips=off", "evaluator.fitted=false", "screen=plain",
    "viewer=viser", "viewer._target_=bench.live.watcher.Watcher",
)  # fmt: skip
LIVE = "realtime=true"
SLOW = {
    "mvs": "mvs._target_=bench.live.slow.SlowStereo",
    "depth_fusion": "depth_fusion._target_=bench.live.slow.SlowFusion",
    "mapper": "mapper._target_=bench.live.slow.SlowMapper",
}
POSE, TO_MAP, TO_PREVIEW = "frame to pose", "keyframe to map", "keyframe to preview"  # latencies
NO_POSE = "none had one as it came"
HANDED_OUT = "last keyframe to the map before its refinement"


@dataclass(frozen=True)
class Way:
    """How a sequence is mapped."""

    name: str
    overrides: tuple[str, ...] = ()
    cores: int = 2


UNHURRIED = Way("unhurried")
GOVERNED = Way("live", (LIVE,))
ONE_CORE = Way("one core", (LIVE,), 1)
SLOWED = tuple(Way(f"{stage} 10 times slower", (LIVE, target)) for stage, target in SLOW.items())
FIXED = tuple(Way(f"stereo effort {k} alone", (LIVE, f"mvs.efforts=[{k}]")) for k in ALL)
WITHOUT = tuple(Way(f"without stereo effort {k}", (LIVE, f"mvs.efforts={[j for j in ALL if j != k]}")) for k in ALL)


@dataclass(frozen=True)
class Result:
    """A run's report; None: it failed."""

    report: dict[str, Any] | None

    def latency(self, node: str, what: str, quantile: str) -> float:
        """Seconds, infinity where nothing arrived."""
        found = figure(self.report, f"latency.{node}.{what}.{quantile}")
        return float("inf") if found is None else found

    def held_out(self, refined: bool) -> dict[int, float]:
        """PSNR, dB, by frame."""
        return held_out_scores(self.report, "rendering" if refined else "rendering_before_refinement")

    @property
    def refinement(self) -> str:
        """How many iterations went from the map before its refinement to the refined one."""
        whole, before = (figure(self.report, f"map.iterations{when}") for when in ("", "_before_refinement"))
        return "unknown" if whole is None or before is None else f"{whole - before:.0f}"

    def count(self, node: str, what: str) -> float:
        return float((self.report or {}).get("counts", {}).get(node, {}).get(what, 0.0))


def below(live: Result, unhurried: Result, refined: bool) -> float:
    """dB by which the held-out PSNR is lower, over the frames of both; infinity without any."""
    here, there = live.held_out(refined), unhurried.held_out(refined)
    common = sorted(here.keys() & there.keys())
    return float(np.mean([there[i] - here[i] for i in common])) if common else float("inf")


def run(scene: str, way: Way, place: Path, options: argparse.Namespace, kept: Kept) -> Result:
    """Maps a scene, or takes a report of the same that is kept."""
    output = place / scene / folder_name(way.name)
    file = output / "report.json"
    given = [*ALWAYS, *way.overrides, *options.overrides]
    asked = {"overrides": given, "cores": way.cores, "stop": options.stop}
    if kept.has(file, asked):
        return Result(json.loads(file.read_text()))
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    path = recording(scene, place, options.stop)
    cores = ",".join(map(str, sorted(os.sched_getaffinity(0))[: way.cores]))
    command = ["taskset", "-c", cores, *launcher(), f"dataset.path={path}", f"output={output}", *given]
    with (output.parent / f"{output.name}.log").open("w") as log:
        subprocess.run(command, cwd=ROOT, env=environment(), stdout=log, stderr=subprocess.STDOUT, check=False)
    report = json.loads(file.read_text()) if file.exists() else None
    if report is None or not report.get("finished", True):
        return Result(None)
    kept.keep(file, asked)
    return Result(report)


def rows_of_pace(name: str, live: Result) -> list[Row]:
    """What a camera's user sees of a run."""
    frames, seen = live.count("dataset", "frames"), live.count("tracker", "frames")
    made, mapped = live.count("tracker", "keyframes"), live.count("mapper", "views")
    slowest, median = (1e3 * live.latency("tracker", POSE, quantile) for quantile in ("p99", "median"))
    posed = at_most(f"{name}: frame to pose, 99 %, ms", slowest, "", 100.0)
    return [
        posed if np.isfinite(slowest) else replace(posed, value=NO_POSE),
        Row(f"{name}: frame to pose, median, ms", median if np.isfinite(median) else NO_POSE),
        Row(f"{name}: frames that a newer one overtook", f"{frames - seen:.0f} of {frames:.0f}"),
        Row(f"{name}: keyframes in the map", f"{mapped:.0f} of {made:.0f}", "", "all", 0 < made == mapped),
        at_most(f"{name}: keyframe to map, median, s", live.latency("mapper", TO_MAP, "median"), "", 1.5),
        at_most(f"{name}: keyframe to map, 99 %, s", live.latency("mapper", TO_MAP, "p99"), "", 3.0),
        Row(f"{name}: keyframe to preview, median, s", live.latency("mapper", TO_PREVIEW, "median")),
        Row(f"{name}: keyframe to preview, 99 %, s", live.latency("mapper", TO_PREVIEW, "p99")),
        Row(f"{name}: less effort", efforts(live)),
    ]


def efforts(live: Result) -> str:
    """Keyframes on which less than the full effort was made, by stage and effort."""
    found = []
    for node in ("mvs", "depth_fusion", "mapper"):
        counts = (live.report or {}).get("skipped", {}).get(node, {})
        found += [
            f"{name.removeprefix('effort on keyframes: ')} {count:.0f}"
            for name, count in counts.items()
            if name.startswith("effort on keyframes: ")
        ]
    return "; ".join(found) or "none"


def rows_of_loss(
    name: str, live: Result, unhurried: Result, before: float | None = None, after: float | None = None
) -> list[Row]:
    """How much worse the live map is, with the goals that there are."""
    rows = []
    for when, refined, goal in (("at the last frame + 2 s", False, before), ("refined", True, after)):
        lost, label = below(live, unhurried, refined), f"{name}: dB below the unhurried map, {when}"
        rows.append(Row(label, lost) if goal is None else at_most(label, lost, "", goal))
    handed_out = live.latency("mapper", HANDED_OUT, "median")
    refinements = f"{live.refinement} ({unhurried.refinement} without hurry)"
    return [
        *rows,
        Row(f"{name}: last keyframe to the map before its refinement, s", handed_out),
        Row(f"{name}: iterations from there to the refined map", refinements),
    ]


def measure_scene(scene: str, place: Path, options: argparse.Namespace, kept: Kept) -> list[Row]:
    rows: list[Row] = []

    def run_way(way: Way) -> Result:
        found = run(scene, way, place, options, kept)
        if found.report is None:
            rows.append(failed(f"{scene}: {way.name}", f"see {place / scene / folder_name(way.name)}.log"))
        return found

    unhurried, governed = run_way(UNHURRIED), run_way(GOVERNED)
    rows += rows_of_pace(f"{scene}: {GOVERNED.name}", governed)
    rows += rows_of_loss(f"{scene}: {GOVERNED.name}", governed, unhurried, 2.0, 0.5)
    if options.quick:
        return rows
    for way in (ONE_CORE, *SLOWED):
        found = run_way(way)
        rows += rows_of_pace(f"{scene}: {way.name}", found)[:4]
        rows += rows_of_loss(f"{scene}: {way.name}", found, unhurried, below(governed, unhurried, False) + 2.0)
    best = float("inf")
    for way in (*FIXED, *WITHOUT):
        found = run_way(way)
        rows += rows_of_pace(f"{scene}: {way.name}", found)[3:6]
        rows += rows_of_loss(f"{scene}: {way.name}", found, unhurried)
        in_time = found.latency("mapper", TO_MAP, "p99") <= 3.0
        if way in FIXED and in_time:  # who is late has not kept the pace, however good the map
            best = min(best, below(found, unhurried, False))
    if np.isfinite(best):
        gain = best - below(governed, unhurried, False)
        rows.append(at_least(f"{scene}: dB above the best effort alone that keeps the pace", gain, "", 0.0))
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"comma separated, of {', '.join(SCENES)}; default: those whose data are here"
    parser.add_argument("--scenes", type=names(SCENES), help=told)
    parser.add_argument("--stop", type=int, help="frames of each; default: all")
    kept_arguments(parser)
    parser.add_argument("overrides", nargs="*", help="for all runs, such as mapper.refinement=300")


def measure(options: argparse.Namespace) -> list[Row]:
    there = available()
    scenes: Sequence[str] = options.scenes or there
    if options.quick and not options.scenes:
        scenes, options.stop = ["room"], options.stop or 90
    place, kept = folder(options, "live"), Kept(options.resume)
    rows = [row for scene in scenes if scene in there for row in measure_scene(scene, place, options, kept)]
    rows += [skipped(scene, SCENES[scene]["path"]) for scene in scenes if scene not in there]
    return rows + kept.origin()


if __name__ == "__main__":
    main(measure, "Real time", arguments)
