"""Whole runs of the graph for benchmarks: scenes x variants x seeds as one Hydra multirun, and their reports."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
CONF = ROOT / "bench" / "conf"


@dataclass(frozen=True)
class Run:
    """One finished run; `report` is None where it failed."""

    scene: str
    variant: str
    seed: int
    folder: Path
    report: dict[str, Any] | None


@dataclass(frozen=True)
class Matrix:
    scenes: Sequence[str]
    variants: Sequence[str] = ("full",)
    seeds: Sequence[int] = (0,)
    overrides: Sequence[str] = field(default_factory=tuple)
    jobs: int = 1  # at once, by joblib; 1: one after the other, as times need

    def check(self) -> None:
        """Raises ValueError, listing what there is, for an unknown scene or variant."""
        for kind, names in (("scene", self.scenes), ("variant", self.variants)):
            known = choices(kind)
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"no {kind} {', '.join(unknown)}; there are: {', '.join(known)}")

    def command(self, output: Path) -> list[str]:
        launcher = ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={self.jobs}"] if self.jobs > 1 else []
        return [
            sys.executable,
            str(ROOT / "launch" / "run_all.py"),
            "-m",
            f"hydra.searchpath=[file://{CONF}]",
            *launcher,
            f"+scene={','.join(self.scenes)}",
            f"+variant={','.join(self.variants)}",
            f"seed={','.join(str(s) for s in self.seeds)}",
            *self.overrides,
            f"output={output}",
            "screen=plain",
        ]

    def run(self, output: Path) -> list[Run]:
        """Runs everything; a run that fails leaves a Run without report and the others go on."""
        self.check()
        output.mkdir(parents=True, exist_ok=True)
        with (output / "runs.log").open("w") as log:
            subprocess.run(self.command(output), cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, check=False)
        return self.collect(output)

    def collect(self, output: Path) -> list[Run]:
        """Reads the reports of an earlier `run` in the same folder."""
        runs = []
        # Hydra numbers jobs in the order of the product, the last argument fastest
        for number, (scene, variant, seed) in enumerate(itertools.product(self.scenes, self.variants, self.seeds)):
            file = output / str(number) / "report.json"
            report = json.loads(file.read_text()) if file.exists() else None
            runs.append(Run(scene, variant, seed, file.parent, report))
        return runs


def choices(kind: str) -> list[str]:
    return sorted(file.stem for file in (CONF / kind).glob("*.yaml"))


def figure(report: dict[str, Any] | None, path: str) -> float | None:
    """A number of a report by its path, such as "rendering.held_out.psnr"; None where there is none."""
    value: Any = report
    for key in path.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return float(value) if isinstance(value, int | float) else None


def machine() -> str:
    """This machine and commit in one line, for the record."""
    model = "unknown CPU"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    git = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or "no commit"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores; commit {commit}"
