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

from bench.faults.launched import Launched, map_opens
from bench.table import Row, all_of, at_most
from launch.outcome import OBSERVER_FAILED

STAGES = ("dataset", "tracker", "mvs", "depth_fusion", "mapper")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP)
SCENE = (
    "device=cpu", "screen=plain", "dataset.size=[96,128]", "dataset.options.frames=120", "dataset.realtime=true",
    "mapper.iterations=8", "mapper.refinement=40", "mapper.checkpoint=0.5", "evaluator.lpips=off",
    "evaluator.max_frames=30", *(f"{stage}.threads=1" for stage in STAGES[1:]),
)  # fmt: skip
SILENT, DEAD = 2.0, 5.0  # seconds: the watchdog's limits where a process is stopped
MOMENTS = 3.0  # seconds after the first map within which the faults come
RECORD = "recorder=mcap"
ATTEMPTS = 5  # to meet a process while it runs
QUICK = ("dataset.options.frames=50", "mapper.refinement=10", "evaluator.max_frames=10")
QUICK_MOMENTS = 0.5
LONGEST_END = 5.0  # seconds
RESUMED_WITHIN = 0.3  # dB


@dataclass(frozen=True)
class Faults:
    """Runs of one scene, and when what befalls them comes."""

    folder: Path
    scene: tuple[str, ...]
    moments: float  # seconds after the first map within which the faults come
    random: random.Random

    def run(self, name: str, *overrides: str) -> Launched:
        output = self.folder / name
        return Launched(output, (*self.scene, f"output={output}", *overrides))

    def struck(self, name: str, victim: str, number: signal.Signals, *overrides: str) -> Launched:
        """A run whose victim has just got that signal, at a moment at which it still ran. Raises RuntimeError."""
        for attempt in range(ATTEMPTS):
            run = self.run(f"{name}-{attempt}" if attempt else name, *overrides)
            if not run.wait_for((run.output / "map.ply").exists):
                run.close()
                raise RuntimeError(f"no map came: {run.said()}")
            time.sleep(self.random.uniform(0.0, self.moments) / (attempt + 1))
            if run.send(victim, number):
                return run
            run.close()
        raise RuntimeError(f"{victim} had always ended soon after the first map: {run.said()}")


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
    scene, moments = ((*SCENE, *QUICK), QUICK_MOMENTS) if quick else (SCENE, MOMENTS)
    with tempfile.TemporaryDirectory() as name:
        faults = Faults(Path(name), scene, moments, random.Random(0))
        whole = _undisturbed(faults)
        cases = [("mapper", signal.SIGKILL)] if quick else [(stage, n) for n in SIGNALS for stage in STAGES] * 4
        rows, resumable = _killed(faults, cases, 1 if quick else 3)
        rows += _observed(faults, 1 if quick else 20, whole)
        rows += _resumed(resumable, whole)
    return rows


def _undisturbed(faults: Faults) -> Path:
    """The output of a run that nothing befell. Raises RuntimeError where it fails."""
    with faults.run("whole") as run:
        if run.wait() != 0:
            raise RuntimeError(run.said())
        return run.output


def _killed(faults: Faults, cases: list[tuple[str, signal.Signals]], resumable: int) -> tuple[list[Row], list[Path]]:
    """Rows, and the outputs of the first runs that lost their mapper."""
    found = Kills()
    kept: list[Path] = []
    for k, (stage, number) in enumerate(cases):
        output = kill(faults, f"killed-{k}", stage, number, found)
        if stage == "mapper" and number != signal.SIGSTOP and len(kept) < resumable:
            kept.append(output)
        else:
            shutil.rmtree(output)
    rows = [
        all_of("stage lost: maps that open", found.maps, found.runs),
        all_of("stage lost: named in the report", found.reported, found.runs),
        at_most("stage lost: processes, sockets, folders left", len(found.left), "", 0),
        at_most("stage killed or ended: all over after, longest", max(found.ends), "s", LONGEST_END),
    ]
    if found.ends_stopped:
        name = "stage stopped: over after the watchdog's limit, longest"
        rows.append(at_most(name, max(found.ends_stopped), "s", LONGEST_END))
    return rows, kept


def kill(faults: Faults, name: str, stage: str, number: signal.Signals, found: Kills) -> Path:
    """One run whose stage gets that signal some time after the first map; its output."""
    limits = (f"supervise.silent={SILENT}", f"supervise.dead={DEAD}") if number == signal.SIGSTOP else ()
    with faults.struck(name, stage, number, *limits) as run:
        began = time.monotonic()
        run.wait()
        seconds = time.monotonic() - began
        found.runs += 1
        found.maps += map_opens(run.output)
        found.reported += run.report().get("failed") == stage
        found.left += run.left()
        if number == signal.SIGSTOP:
            found.ends_stopped.append(seconds - DEAD)
        else:
            found.ends.append(seconds)
        return run.output


def _observed(faults: Faults, runs: int, whole: Path) -> list[Row]:
    """Runs whose observers have no room on their disk, and, every other one, that have an observer killed."""
    finished = equal = 0
    for k in range(runs):
        full = (
            "recorder._target_=bench.faults.full_disk.FullRecorder",
            "evaluator._target_=bench.faults.full_disk.FullEvaluator",
        )
        name, victim = f"observed-{k}", ("evaluator", "recorder")[k // 2 % 2]
        kill = k % 2 == 1
        with faults.struck(name, victim, signal.SIGKILL, RECORD) if kill else faults.run(name, RECORD, *full) as run:
            finished += run.wait() == OBSERVER_FAILED
            equal += (run.output / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
        shutil.rmtree(run.output)
    return [
        all_of("observer killed, or its disk full: runs that finish and say so", finished, runs),
        all_of("observer killed, or its disk full: the map of an undisturbed run", equal, runs),
    ]


def _resumed(outputs: list[Path], whole: Path) -> list[Row]:
    """Unfinished runs, resumed: how far from the undisturbed run they end."""
    differences = []
    for output in outputs:
        with Launched(output, (f"resume={output}",)) as run:
            if run.wait() != 0:
                raise RuntimeError(run.said())
        differences += [_psnr(whole, part) - _psnr(output, part) for part in ("keyframes", "held_out")]
    return [at_most("resumed: PSNR below the undisturbed run's, most", max(differences), "dB", RESUMED_WITHIN)]


def _psnr(output: Path, part: str) -> float:
    report = json.loads((output / "report.json").read_text())
    return float(report["rendering"][part]["psnr"])
