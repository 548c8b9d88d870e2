"""Our side: a run of the system, with what others get of it: its frames, which of them are keyframes or held out."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from bench import pieces
from bench.finished import read_frames
from bench.runs import Matrix, Run, folder_name, held_out_scores, said
from msgs import GroundTruth
from mvsgs_core.evaluation import trajectory_metrics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.mapping.config import MapperConfig


@dataclass(frozen=True)
class Ours:
    """A run of the system."""

    report: dict[str, Any]
    track: dict[str, list[Any]]
    frames: dict[int, GroundTruth]
    settings: dict[str, Any] = field(default_factory=dict)  # of the reader
    iterations: str = ""  # of the mapper, as `fewer_iterations` calls them

    @property
    def keyframes(self) -> list[int]:
        return [i for i, keyframe in zip(self.track["index"], self.track["keyframe"]) if keyframe]

    @property
    def held_out(self) -> list[int]:
        mapped = set(self.keyframes)
        return [i for i in self.frames if is_held_out(i) and i not in mapped]

    @property
    def not_held_out(self) -> list[int]:
        """What a trainer may see."""
        held_out = set(self.held_out)
        return [i for i in self.frames if i not in held_out]

    @property
    def poses(self) -> dict[int, np.ndarray]:
        pairs = zip(self.track["index"], self.track["world_from_cam"])
        return {i: np.array(pose) for i, pose in pairs if pose is not None}

    @property
    def exposures(self) -> dict[int, np.ndarray] | None:
        """(3, 4) by frame, as the tracker measured them in its matches; None where it found none."""
        found = self.track.get("exposure")
        if found is None:
            return None
        return {i: np.array(affine) for i, affine in zip(self.track["index"], found) if affine is not None}

    @property
    def vignetting(self) -> np.ndarray | None:
        """(3,) of the sensor, as the tracker measured it; None where it found none."""
        found = self.track.get("vignetting")
        return None if found is None else np.array(found, dtype=np.float64)

    @property
    def optimization(self) -> float:
        """Processor seconds of the mapper, its start included."""
        return float(self.report["time"]["cpu"]["mapper"])

    @property
    def everything(self) -> float:
        """Processor seconds from frames to map: all nodes but the evaluator."""
        return processor_seconds(self.report)

    @property
    def scored(self) -> list[int]:
        """Frames that are held out and on which our map is scored: those that have a pose."""
        there = held_out_scores(self.report).keys()
        return [i for i in self.held_out if i in there]

    def psnr(self, frames: set[int]) -> float:
        """Mean over those of `frames` that are held out."""
        return held_out_psnr(self.report, frames)


def held_out_psnr(report: dict[str, Any], frames: set[int]) -> float:
    """Mean over those of `frames` that are held out in a run."""
    return float(np.mean([psnr for index, psnr in held_out_scores(report).items() if index in frames]))


def processor_seconds(report: dict[str, Any]) -> float:
    """Of all nodes but the evaluator, which is no part of the system."""
    return float(sum(seconds for node, seconds in report["time"]["cpu"].items() if node != "evaluator"))


def run_ours(
    scene: str, overrides: list[str], fewer: dict[str, tuple[str, ...]], output: Path, made: pieces.Pieces
) -> tuple[Ours | None, dict[str, Run]]:
    """Our run, and those with fewer iterations by their name; None where it failed (runs.log in `output` says why), or
    is not there yet. The mapper has one thread, as the offline trainer has."""
    given = ["recorder=track", "mapper.threads=1", "evaluator.max_frames=2000", "evaluator.max_bytes=2e10"]
    runs = {}
    for name, settings in {"full": (), **fewer}.items():
        folder = output / folder_name(name)
        matrix = Matrix([scene], overrides=[*given, *overrides, *settings])
        found = made.runs({str(folder.relative_to(made.output)): matrix})  # nothing where it is missing
        runs[name] = found[0] if found else Run(scene, "full", 0, folder / "0", None)
    full = runs.pop("full")
    if full.report is None or not (full.folder / "track.json").exists():
        return None, runs
    config = OmegaConf.to_container(OmegaConf.load(full.folder / "config.yaml"))
    assert isinstance(config, dict)
    track = json.loads((full.folder / "track.json").read_text())
    reader = dict(config["dataset"])
    return Ours(full.report, track, read_frames(reader), reader, iterations_of(config["mapper"])), runs


def iterations_of(mapper: dict[str, Any]) -> str:
    """What the mapper's parameters say of its iterations, as `fewer_iterations` calls them."""
    given = {name: mapper[name] for name in ("iterations", "refinement", "realtime")}
    each = f"{MapperConfig(**given).budget} a keyframe"
    return each if given["refinement"] is None else f"{each}, {given['refinement']} at the end"


def why_not(scene: str, output: Path) -> str:
    """What `run_ours` said of a run of which there is none, and where more of it is."""
    return f"{said(Run(scene, 'full', 0, output / 'full' / '0', None))} (see {output / 'full' / 'runs.log'})"


def cheapest(ours: Ours, fewer: dict[str, Run], psnr: float, frames: set[int]) -> tuple[str, float] | None:
    """Of our runs that reach a PSNR, over those of `frames` that are held out, the one of the fewest processor seconds,
    and these; None: none does."""
    reports = {ours.iterations: ours.report, **{n: run.report for n, run in fewer.items() if run.report}}
    found = {
        name: processor_seconds(report) for name, report in reports.items() if held_out_psnr(report, frames) >= psnr
    }
    name = min(found, key=lambda n: found[n], default=None)
    return None if name is None else (name, found[name])


def ate_percent(poses: dict[int, np.ndarray], ours: Ours, frames: list[int]) -> float | None:
    """RMSE in percent of the path's length, over those of `frames` that have both poses; None without alignment."""
    truths = {i: ours.frames[i].world_from_cam for i in frames}
    known = [i for i in frames if i in poses and truths[i] is not None]
    if len(known) < 3:
        return None
    estimate = np.array([poses[i] for i in known])
    truth = np.array([truths[i] for i in known], dtype=np.float64)
    errors = trajectory_metrics.absolute_errors(estimate, truth, trajectory_metrics.align(estimate, truth))
    return 100 * trajectory_metrics.rmse(errors) / trajectory_metrics.path_length(truth)
