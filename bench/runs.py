"""Whole runs of the graph: scenes x variants x settings x seeds as one Hydra multirun, and their reports."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from mvsgs_core.evaluation import metrics

ROOT = Path(__file__).resolve().parent.parent
CONF = ROOT / "bench" / "conf"
SHARED = Path(os.environ.get("MVSGS_SHARED", ROOT.parent / "shared"))
DATA = SHARED / "data"
FEWER = "runs of ours besides: iterations a keyframe and at the end, such as 10:100,5:50, or 5: at the end by rule"
QUICK = ("dataset.stop=30", "mapper.iterations=15", "mapper.refinement=50")  # overrides of a quick run


@dataclass(frozen=True)
class Setting:
    """A named set of overrides, such as Setting("area_19200", ("tracker.area=19200", "mvs=coarse"))."""

    name: str
    overrides: tuple[str, ...] = ()

    def text(self, first: Sequence[str] = ()) -> str:
        """The Hydra choice that makes them, after those in `first`. Raises ValueError for what is not key=value."""
        parser = OverridesParser.create()  # values as on the command line: "off" is no boolean there, in YAML it is
        choices: dict[str, Any] = {}
        config = OmegaConf.create()
        for override in (*first, *self.overrides):
            try:
                parsed = parser.parse_override(override)
            except HydraException as error:
                raise ValueError(
                    f"{self.name}: {override!r} must look like slot=choice or slot.parameter=value"
                ) from error
            key = parsed.key_or_group
            if "." in key or key == "seed":
                OmegaConf.update(config, key, parsed.value(), force_add=True)
            else:
                choices[f"override /{key}"] = parsed.value()
        config.defaults = [*({key: value} for key, value in choices.items()), "_self_"]
        return f"# @package _global_\n{OmegaConf.to_yaml(config)}"


def fewer_iterations(text: str | None) -> dict[str, tuple[str, ...]]:
    """Overrides of other runs, by what they are, of "10:100,5": so many iterations a keyframe and at the end, or
    as many at the end as the mapper makes of that. Raises ValueError for anything else."""
    found: dict[str, tuple[str, ...]] = {}
    for part in text.split(",") if text else ():
        each, colon, last = part.partition(":")
        if not each.isdecimal() or (colon and not last.isdecimal()):
            raise ValueError(f"{part!r} must be iterations a keyframe and at the end, such as 10:100")
        name = f"{each} a keyframe, {last} at the end" if colon else f"{each} a keyframe"
        end = (f"mapper.refinement={last}",) if colon else ()
        found[name] = (f"mapper.iterations={each}", *end)
    return found


@dataclass(frozen=True)
class Run:
    """One finished run; `report` is None where it failed."""

    scene: str
    variant: str
    seed: int
    folder: Path
    report: dict[str, Any] | None
    setting: str = ""


@dataclass(frozen=True)
class Matrix:
    """Everything with everything; `settings` are written beside the runs, as choices of their own.

    Stronger from left to right: the scene, the variant, `overrides`, the setting.
    """

    scenes: Sequence[str]
    variants: Sequence[str] = ("full",)
    seeds: Sequence[int] = (0,)
    overrides: Sequence[str] = field(default_factory=tuple)
    jobs: int = 1  # at once, by joblib; 1: one after the other, as times need
    settings: Sequence[Setting] = field(default_factory=tuple)
    prefix: Sequence[str] = field(default_factory=tuple)  # before the command: ("taskset", "-c", "0")
    checkout: Path = ROOT  # whose code runs; its own scenes and variants go before those of this one

    def check(self) -> None:
        """Raises ValueError, listing what there is, for an unknown scene or variant, and for a checkout of no code."""
        for kind, names in (("scene", self.scenes), ("variant", self.variants)):
            known = choices(kind)
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"no {kind} {', '.join(unknown)}; there are: {', '.join(known)}")
        names = [setting.name for setting in self.settings]
        if len(set(names)) < len(names):
            raise ValueError(f"two settings of one name: {', '.join(names)}")
        if not (self.checkout / "launch" / "run_all.py").is_file():
            raise ValueError(f"{self.checkout} is no checkout of this project: it has no launch/run_all.py")

    def command(self, output: Path) -> list[str]:
        parallel = ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={self.jobs}"] if self.jobs > 1 else []
        conf = self.checkout / "bench" / "conf"
        search = [f"file://{folder}" for folder in dict.fromkeys((conf, CONF)) if folder.is_dir()]
        settings = []
        if self.settings:
            search.append(f"file://{_settings_folder(output)}")
            settings = [f"+setting={','.join(setting.name for setting in self.settings)}"]
        return [
            *self.prefix,
            *launcher(self.checkout),
            "-m",
            f"hydra.searchpath=[{','.join(search)}]",
            *parallel,
            f"+scene={','.join(self.scenes)}",
            f"+variant={','.join(self.variants)}",
            *settings,
            f"seed={','.join(str(s) for s in self.seeds)}",
            *([] if self.settings else self.overrides),  # on the command line they would be stronger than a setting
            f"output={output}",
            "screen=plain",
        ]

    def write_settings(self, output: Path) -> None:
        """What `command` needs on disk."""
        folder = _settings_folder(output) / "setting"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for setting in self.settings:
            (folder / f"{setting.name}.yaml").write_text(setting.text(self.overrides))

    def start(self, output: Path) -> subprocess.Popen[bytes]:
        """Starts everything; earlier results in `output` are removed. Its screen goes to output/runs.log."""
        self.check()
        output.mkdir(parents=True, exist_ok=True)
        for number in range(len(self.names())):
            shutil.rmtree(output / str(number), ignore_errors=True)
        self.write_settings(output)
        with (output / "runs.log").open("w") as log:
            return subprocess.Popen(
                self.command(output), cwd=self.checkout, stdout=log, stderr=subprocess.STDOUT, env=environment()
            )

    def run(self, output: Path) -> list[Run]:
        """Runs everything; a run that fails leaves a Run without report and the others go on."""
        process = self.start(output)
        try:
            process.wait()
        except BaseException:
            process.terminate()  # the launcher stops its nodes
            process.wait()
            raise
        return self.collect(output)

    def names(self) -> list[tuple[str, str, str, int]]:
        """Scene, variant, setting and seed of each job: Hydra's order, the last argument fastest."""
        settings = [setting.name for setting in self.settings] or [""]
        return list(itertools.product(self.scenes, self.variants, settings, self.seeds))

    def collect(self, output: Path) -> list[Run]:
        """Reads the reports of an earlier `run` in the same folder."""
        runs = []
        for number, (scene, variant, setting, seed) in enumerate(self.names()):
            file = output / str(number) / "report.json"
            report = json.loads(file.read_text()) if file.exists() else None
            if report is not None and report.get("finished") is False:
                report = None  # of a run that ended early; what it reached is no result
            runs.append(Run(scene, variant, seed, file.parent, report, setting))
        return runs


def python(checkout: Path = ROOT) -> str:
    """The interpreter that runs a checkout: this one, or another checkout's own, where it has a .venv."""
    own = checkout / ".venv" / "bin" / "python"
    return str(own) if checkout != ROOT and own.exists() else sys.executable


def launcher(checkout: Path = ROOT) -> list[str]:
    """The command that starts a run of a checkout, without its arguments."""
    return [python(checkout), str(checkout / "launch" / "run_all.py")]


def launch(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """One run of the launcher, to its end; its screen is in the result. Raises CalledProcessError where it fails."""
    given = {"check": True, "cwd": ROOT, "env": environment(), **options}
    return subprocess.run([*launcher(), *arguments], capture_output=True, text=True, **given)


def environment() -> dict[str, str]:
    """Environment of the runs: data and network weights from the shared folder, unless it says otherwise."""
    weights = SHARED / "weights"
    found = {"MVSGS_WEIGHTS": str(weights)} if weights.is_dir() else {}
    return {"MVSGS_SHARED": str(SHARED), **found, **os.environ}


def choices(kind: str) -> list[str]:
    return sorted(file.stem for file in (CONF / kind).glob("*.yaml"))


def missing_data(scene: str) -> Path | None:
    """Where a scene's data should be on this machine; None where they are there, or need none."""
    path = OmegaConf.load(CONF / "scene" / f"{scene}.yaml").dataset.get("path")
    return None if path is None or (ROOT / path).exists() else ROOT / path


def available_scenes() -> list[str]:
    """The scenes whose data are on this machine."""
    return [name for name in choices("scene") if missing_data(name) is None]


def folder(options: argparse.Namespace, name: str) -> Path:
    """Where a benchmark's runs go: as asked for with --output, or runs/bench/NAME, runs/bench-quick/NAME."""
    given = options.output or ROOT / "runs" / ("bench-quick" if options.quick else "bench") / name
    given.mkdir(parents=True, exist_ok=True)
    return Path(given).resolve()


def folder_name(text: str) -> str:
    """A name for a folder that Hydra's command line takes, too."""
    return "".join(c for c in text.replace(" ", "_") if c.isalnum() or c in "_.-")


def figure(report: dict[str, Any] | None, path: str) -> float | None:
    """A number of a report by its path, such as "rendering.held_out.psnr"; None where there is none."""
    return metrics.number(report or {}, path)


def held_out_scores(report: dict[str, Any] | None, part: str = "rendering") -> dict[int, float]:
    """PSNR, dB, of the held-out frames that have one, by frame. part: of the report."""
    frames = ((report or {}).get(part) or {}).get("frames", ())
    return {frame["index"]: frame["psnr"] for frame in frames if frame["held_out"] and frame["psnr"] is not None}


def stage_seconds(report: dict[str, Any] | None, node: str) -> float:
    """Seconds that a node worked, over all of its stages."""
    stages = (report or {}).get("time", {}).get("stages", {}).get(node, {})
    return float(sum(stages.values()))


def said(run: Run) -> str:
    """What the system itself reported of a run: its warnings, or why it failed."""
    if run.report is None:
        log = run.folder.parent / "runs.log"
        lines = log.read_text().splitlines() if log.exists() else []
        pairs = itertools.pairwise(lines)
        own = [line for line, after in pairs if " failed: " in line and f"{run.folder}/logs" in after]
        begins = [k for k, line in enumerate(lines) if line.startswith(f"job {run.folder.name}:")]
        after = lines[begins[0] :] if begins else lines
        # before a run starts no folder is named; the cause comes first, then what follows from it
        refused = [line for line in after if line.startswith("error: ")][:1]
        return (own or refused or ["no report"])[-1]
    warned = [f"{node}: {text}" for node, texts in run.report.get("warnings", {}).items() for text in texts]
    return "; ".join(warned) or "nothing"


def commit(checkout: Path = ROOT) -> str:
    """The commit that runs, with a plus where files under version control differ from it."""
    git = ["git", "-C", str(checkout)]
    name = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    # the records themselves are not part of what is measured
    differs = subprocess.run(
        [*git, "diff", "--quiet", "HEAD", "--", ".", ":!BENCHMARKS.md", ":!bench/recorded", ":!docs"], check=False
    ).returncode
    return (name.stdout.strip() or "no commit") + ("+" if name.stdout and differs else "")


def _settings_folder(output: Path) -> Path:
    return output / "settings"
