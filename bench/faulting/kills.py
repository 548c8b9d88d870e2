"""Processes of a run killed, ended and stopped at random moments: what map is left, how fast all is over, and whether
the run goes on from there; and who only observes killed, or without room on its disk, in runs that must not mind.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from bench.launched import Launched, map_opens
from bench.table import Row, at_most

STAGES = ("dataset", "tracker", "mvs", "depth_fusion", "mapper")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP)
SCENE = (
    "device=cpu", "screen=plain", "dataset.size=[96,128]", "dataset.options.frames=100", "dataset.realtime=true",
    "mapper.iterations=8", "mapper.refinement=40", "mapper.checkpoint=0.5", "evaluator.lpips=off",
    "evaluator.max_frames=30", *(f"{stage}.threads=1" for stage in STAGES[1:]),
)  # fmt: skip
SILENT, DEAD = 2.0, 5.0  # seconds: the watchdog's limits where a process is stopped
MOMENTS = 3.0  # seconds after the first map within which the faults come
LONGEST_END = 5.0  # seconds
RESUMED_WITHIN = 0.3  # dB


@dataclass
class Kills:
    """What was found in runs that lost a stage."""

    runs: int = 0
    maps: int = 0
    left: list[str] = field(default_factory=list)
    reported: int = 0  # runs whose report names the stage
    ends: list[float] = field(default_factory=list)  # seconds, killed and ended
    ends_stopped: list[float] = field(default_factory=list)  # seconds beyond the watchdog's limit


def measure(quick: bool) -> list[Row]:
    moments = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole = _run(folder / "whole")
        rows = _killed(folder, moments, 3 if quick else 60)
        rows += _observed(folder, moments, 2 if quick else 20, whole)
        rows += _resumed(folder, moments, 1 if quick else 3, whole)
    return rows


def _run(output: Path, *overrides: str) -> Path:
    """A run that nothing disturbs. Raises RuntimeError where it fails."""
    with Launched(output, (*SCENE, f"output={output}", *overrides)) as run:
        if run.wait() != 0:
            raise RuntimeError(run.said())
    return output


def _killed(folder: Path, moments: random.Random, runs: int) -> list[Row]:
    found = Kills()
    cases = [(stage, number) for number in SIGNALS for stage in STAGES]
    if runs < len(cases):
        cases = [("tracker", signal.SIGKILL), ("mapper", signal.SIGTERM), ("mvs", signal.SIGSTOP)]
    for k in range(runs):
        output = folder / f"killed-{k}"
        _kill(output, *cases[k % len(cases)], moments.uniform(0.0, MOMENTS), found)
        shutil.rmtree(output)
    rows = [
        _all("stage lost: maps that open", found.maps, found.runs),
        _all("stage lost: named in the report", found.reported, found.runs),
        at_most("stage lost: processes, sockets, folders left", len(found.left), "", 0),
        at_most("stage killed or ended: all over after, longest", max(found.ends), "s", LONGEST_END),
    ]
    if found.ends_stopped:
        rows.append(
            at_most(
                "stage stopped: over after the watchdog's limit, longest", max(found.ends_stopped), "s", LONGEST_END
            )
        )
    return rows


def _kill(output: Path, stage: str, number: signal.Signals, moment: float, found: Kills) -> None:
    """One run whose stage gets that signal so many seconds after the first map."""
    limits = (f"supervise.silent={SILENT}", f"supervise.dead={DEAD}") if number == signal.SIGSTOP else ()
    with Launched(output, (*SCENE, f"output={output}", *limits)) as run:
        if not run.wait_for((output / "map.ply").exists):
            raise RuntimeError(f"no map came: {run.said()}")
        time.sleep(moment)
        if not run.send(stage, number):
            raise RuntimeError(f"{stage} had ended {moment:.1f} s after the first map: {run.said()}")
        began = time.monotonic()
        run.wait()
        seconds = time.monotonic() - began
        found.runs += 1
        found.maps += map_opens(output)
        found.reported += run.report().get("failed") == stage
        found.left += run.left()
        if number == signal.SIGSTOP:
            found.ends_stopped.append(seconds - DEAD)
        else:
            found.ends.append(seconds)


def _observed(folder: Path, moments: random.Random, runs: int, whole: Path) -> list[Row]:
    """Every other run has an observer killed, every other one observers without room on their disk."""
    finished = equal = 0
    for k in range(runs):
        output = folder / f"observed-{k}"
        full = ("recorder._target_=bench.full_disk.FullRecorder", "evaluator._target_=bench.full_disk.FullEvaluator")
        overrides = ("recorder=mcap", *(full if k % 2 else ()))
        with Launched(output, (*SCENE, f"output={output}", *overrides)) as run:
            if k % 2 == 0 and run.wait_for((output / "map.ply").exists):
                time.sleep(moments.uniform(0.0, MOMENTS))
                run.send(("evaluator", "recorder")[k // 2 % 2], signal.SIGKILL)
            finished += run.wait() == 4
            equal += (output / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
        shutil.rmtree(output)
    return [
        _all("observer killed, or its disk full: runs that finish and say so", finished, runs),
        _all("observer killed, or its disk full: the map of an undisturbed run", equal, runs),
    ]


def _resumed(folder: Path, moments: random.Random, runs: int, whole: Path) -> list[Row]:
    """Runs whose mapper was killed, resumed: how far from the undisturbed run they end."""
    differences = []
    for k in range(runs):
        output = folder / f"resumed-{k}"
        with Launched(output, (*SCENE, f"output={output}")) as run:
            run.wait_for((output / "map.ply").exists)
            time.sleep(moments.uniform(0.0, MOMENTS))
            run.send("mapper", signal.SIGKILL)
            run.wait()
        with Launched(output, (f"resume={output}",)) as run:
            if run.wait() != 0:
                raise RuntimeError(run.said())
        differences += [_psnr(whole, part) - _psnr(output, part) for part in ("keyframes", "held_out")]
    return [at_most("resumed: PSNR below the undisturbed run's, most", max(differences), "dB", RESUMED_WITHIN)]


def _psnr(output: Path, part: str) -> float:
    report = json.loads((output / "report.json").read_text())
    return float(report["rendering"][part]["psnr"])


def _all(name: str, met: int, runs: int) -> Row:
    return Row(name, f"{met} of {runs}", "", f"{runs} of {runs}", met == runs)
