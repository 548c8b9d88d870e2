"""Other ways to the same result on the same frames, beside ours.

Poses: COLMAP (pycolmap) with sequential matching on our keyframes and every 5th frame, calibration given. Map: an
offline 3D Gaussian splatting of COLMAP's sparse points with COLMAP's poses, by our own rasterizer and optimizer. It is
trained on the frames that are keyframes of ours and scored on our held-out frames (every 5th that is no keyframe): for
as long as our mapper optimized, then twice as long and so on, until doubling the time gains less than 0.1 dB.
Both run alone on all cores; our mapper shares them with the other nodes.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from bench.colmap_poses import Model, reconstruct
from bench.runs import Matrix, figure, folder, stage_seconds
from bench.sparse_splats import Posed, SparseConfig, SparseMap
from bench.table import Row, main
from launch.placement import available_cores
from msgs import GroundTruth
from mvsgs_core.evaluation import image_metrics, trajectory
from mvsgs_core.evaluation.scoring import HELD_OUT_EVERY
from mvsgs_core.splats.training import TrainingConfig
from nodes.reader import Reader

GAIN = 0.1  # dB: a doubling of the time that brings less is the end


@dataclass(frozen=True)
class Ours:
    """A run of the system."""

    report: dict[str, Any]
    track: dict[str, list[Any]]
    frames: dict[int, GroundTruth]

    @property
    def keyframes(self) -> list[int]:
        return [i for i, keyframe in zip(self.track["index"], self.track["keyframe"]) if keyframe]

    @property
    def held_out(self) -> list[int]:
        mapped = set(self.keyframes)
        return [i for i in self.frames if i % HELD_OUT_EVERY == 0 and i not in mapped]

    @property
    def poses(self) -> dict[int, np.ndarray]:
        pairs = zip(self.track["index"], self.track["world_from_cam"])
        return {i: np.array(pose) for i, pose in pairs if pose is not None}

    @property
    def optimization(self) -> float:
        """Seconds that the mapper worked."""
        stages = self.report["time"]["stages"]["mapper"]
        return float(sum(stages.get(name, 0.0) for name in ("insertion", "optimization", "refinement")))


@dataclass(frozen=True)
class Trained:
    """One optimization of COLMAP's points: held-out scores after `seconds`."""

    seconds: float
    psnr: float
    ssim: float
    splats: int
    iterations: int


def run_ours(scene: str, overrides: list[str], output: Path, collect: bool = False) -> Ours | None:
    """None where the run failed: runs.log in `output` says why."""
    matrix = Matrix([scene], overrides=[*overrides, "recorder=track", "evaluator.max_frames=2000"])
    result = (matrix.collect(output) if collect else matrix.run(output))[0]
    if result.report is None or not (result.folder / "track.json").exists():
        return None
    config = OmegaConf.to_container(OmegaConf.load(result.folder / "config.yaml"))
    assert isinstance(config, dict)
    known = set(vars(Reader.Config()))
    settings = {str(k): v for k, v in config["dataset"].items() if k in known}
    messages = Reader(Reader.Config(**settings)).run()
    frames = {message.index: message for message in messages if isinstance(message, GroundTruth)}
    return Ours(result.report, json.loads((result.folder / "track.json").read_text()), frames)


def ate_percent(poses: dict[int, np.ndarray], ours: Ours, frames: list[int]) -> float | None:
    """RMSE in percent of the path's length, over those of `frames` that have both poses; None without alignment."""
    truths = {i: ours.frames[i].world_from_cam for i in frames}
    known = [i for i in frames if i in poses and truths[i] is not None]
    if len(known) < 3:
        return None
    estimate = np.array([poses[i] for i in known])
    truth = np.array([truths[i] for i in known], dtype=np.float64)
    errors = trajectory.absolute_errors(estimate, truth, trajectory.align(estimate, truth))
    return 100 * trajectory.rmse(errors) / trajectory.path_length(truth)


def train(model: Model, ours: Ours, config: SparseConfig) -> Trained:
    """Raises ValueError where COLMAP has none of our keyframes, or no points."""
    poses = dict(zip(model.index.tolist(), model.world_from_cam))

    def posed(index: int) -> Posed:
        frame = ours.frames[index]
        return Posed(index, frame.image, frame.intrinsics, poses[index])

    views = [posed(i) for i in ours.keyframes if i in poses]
    fitted = SparseMap(views, model.points, model.colors, config)
    fitted.optimize()
    scores = []
    for view in (posed(i) for i in ours.held_out if i in poses):
        photograph = view.image.astype(np.float32) / 255.0
        color = fitted.render(view)
        scores.append((image_metrics.psnr(color, photograph), image_metrics.ssim(color, photograph)))
    psnr, ssim = np.mean(scores, axis=0) if scores else (np.nan, np.nan)
    return Trained(fitted.seconds, float(psnr), float(ssim), len(fitted.state), fitted.iterations)


def train_longer(model: Model, ours: Ours, longest: float, threads: int) -> list[Trained]:
    """Equal time first, then doubled until the gain is small, to at most `longest` times as long."""
    config = SparseConfig(seconds=ours.optimization, training=TrainingConfig(threads=threads))
    results = [train(model, ours, config)]
    while 2 * config.seconds <= longest * ours.optimization * 1.001:
        config = replace(config, seconds=2 * config.seconds)
        results.append(train(model, ours, config))
        if results[-1].psnr - results[-2].psnr < GAIN:
            break
    return results


def pose_rows(scene: str, ours: Ours, model: Model, frames: list[int]) -> list[Row]:
    theirs = dict(zip(model.index.tolist(), model.world_from_cam))
    common = [i for i in frames if i in theirs]
    rows = []
    for name, poses in (("ours", ours.poses), ("COLMAP", theirs)):
        posed = sum(i in poses for i in frames)
        rows.append(Row(f"{scene}: poses, {name}: frames posed", f"{posed} of {len(frames)}"))
        rows.append(Row(f"{scene}: poses, {name}: ATE, frames that COLMAP has", ate_percent(poses, ours, common), "%"))
    rows.insert(2, Row(f"{scene}: poses, ours: seconds", stage_seconds(ours.report, "tracker"), "s"))
    rows.append(Row(f"{scene}: poses, COLMAP: seconds", sum(model.seconds.values()), "s"))
    rows.append(Row(f"{scene}: poses, COLMAP: sparse points", len(model.points)))
    return rows


def map_rows(scene: str, ours: Ours, model: Model, trained: list[Trained]) -> list[Row]:
    rows = [
        Row(f"{scene}: map, ours: held-out PSNR", figure(ours.report, "rendering.held_out.psnr"), "dB"),
        Row(f"{scene}: map, ours: held-out SSIM", figure(ours.report, "rendering.held_out.ssim")),
        Row(f"{scene}: map, ours: seconds of optimization", ours.optimization, "s"),
        Row(f"{scene}: map, ours: seconds, frames to map", figure(ours.report, "time.wall"), "s"),
        Row(f"{scene}: map, ours: splats", figure(ours.report, "map.splats")),
        Row(f"{scene}: map, ours: iterations", figure(ours.report, "map.iterations")),
    ]
    for before, result in zip([None, *trained], trained):
        times = round(result.seconds / ours.optimization)
        name = f"{scene}: map, COLMAP + splatting, " + ("equal time" if times == 1 else f"{times} times as long")
        rows += [
            Row(f"{name}: held-out PSNR", result.psnr, "dB"),
            Row(f"{name}: held-out SSIM", result.ssim),
            Row(f"{name}: seconds of optimization", result.seconds, "s"),
            Row(f"{name}: seconds, frames to map", result.seconds + sum(model.seconds.values()), "s"),
            Row(f"{name}: splats", result.splats),
            Row(f"{name}: iterations", result.iterations),
        ]
        if before is not None:
            rows.append(Row(f"{name}: gain by twice the time", result.psnr - before.psnr, "dB"))
    return rows


def compare(scene: str, options: argparse.Namespace, overrides: list[str]) -> list[Row]:
    place = folder(options, "peers") / scene
    ours = run_ours(scene, overrides, place / "ours", options.collect)
    if ours is None:
        return [Row(f"{scene}: ours", f"failed: see {place / 'ours' / 'runs.log'}", "", "a report", False)]
    frames = sorted({*ours.keyframes, *(i for i in ours.frames if i % HELD_OUT_EVERY == 0)})
    threads = options.threads or available_cores()
    images = {i: ours.frames[i].image for i in frames}
    model, problem = reconstruct(images, ours.frames[frames[0]].intrinsics, place / "colmap", threads)
    if model is None:
        return [Row(f"{scene}: COLMAP", problem)]
    rows = pose_rows(scene, ours, model, frames)
    try:
        trained = train_longer(model, ours, options.longest, threads)
    except ValueError as error:
        return [*rows, Row(f"{scene}: map, COLMAP + splatting", str(error))]
    return rows + map_rows(scene, ours, model, trained)


def markdown(rows: list[Row]) -> str:
    """A table of poses and one of maps, a line each scene and method, from rows named "scene: kind, method: figure"."""
    tables: dict[str, dict[tuple[str, str], dict[str, str]]] = {"poses": {}, "map": {}}
    failures = []
    for row in rows:
        scene, method, *figure_name = row.name.split(": ", 2)
        kind, _, method = method.partition(", ")
        shown = "–" if row.value is None else f"{row.value:.4g}" if isinstance(row.value, float) else str(row.value)
        if kind in tables and figure_name:
            tables[kind].setdefault((scene, method), {})[figure_name[0]] = f"{shown} {row.unit}".strip()
        else:
            failures.append(f"{row.name}: {shown}")
    text = []
    for kind, lines in tables.items():
        names = list(dict.fromkeys(name for figures in lines.values() for name in figures))
        text += [f"| scene | {kind} | " + " | ".join(names) + " |", "|---|---|" + "---:|" * len(names)]
        for (scene, method), figures in lines.items():
            text.append(f"| {scene} | {method} | " + " | ".join(figures.get(name, "") for name in names) + " |")
        text.append("")
    return "\n".join([*text, *failures]) + "\n"


def measure(options: argparse.Namespace) -> list[Row]:
    scenes = options.scenes.split(",")
    overrides = list(options.overrides)
    if options.quick:
        scenes, options.longest = scenes[:1], 1.0
        overrides += ["dataset.stop=30", "mapper.iterations=15", "mapper.refinement=50"]
    rows = [row for scene in scenes for row in compare(scene, options, overrides)]
    (folder(options, "peers") / "table.md").write_text(markdown(rows))
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", default="room,tum_fr1_xyz,redkitchen", help="comma separated")
    parser.add_argument("--longest", type=float, default=4.0, help="times our optimization's time, for the offline one")
    parser.add_argument("--threads", type=int, help="of COLMAP and of the offline optimization; default: all cores")
    parser.add_argument("--output", type=Path, help="folder of the runs; default: in runs")
    parser.add_argument("--collect", action="store_true", help="our runs are in the folder already")
    parser.add_argument("overrides", nargs="*", help="of our runs: dataset.stop=100")


if __name__ == "__main__":
    main(measure, "Peers on the same frames", arguments)
