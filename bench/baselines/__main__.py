"""Other ways to the same result on the same frames, beside ours.

Poses: COLMAP (pycolmap) with sequential matching, calibration given, on our keyframes, every 5th frame and a hundred
evenly, at up to 512x384 pixels: more than our tracker looks at. Map: an offline 3D Gaussian splatting of COLMAP's
sparse points with COLMAP's poses, by our own rasterizer and optimizer, at the size of our run. It is trained on the
frames that are keyframes of ours and scored on our held-out frames (every 5th that is no keyframe): for as long as our
mapper optimized, then twice as long and so on, until doubling the time gains less than 0.1 dB.
Both run alone on all cores; our mapper shares them with the other nodes. What ended is kept for --resume.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from bench import pieces
from bench.baselines.colmap_poses import Model
from bench.baselines.sparse_splats import Posed, SparseConfig, SparseMap
from bench.runs import QUICK, Matrix, figure, folder, stage_seconds
from bench.table import Row, main
from bench.tracking.baselines import Baseline, solve
from launch.placement import available_cores
from msgs import GroundTruth
from mvsgs_core import image_metrics
from mvsgs_core.datasets import Item
from mvsgs_core.evaluation import trajectory_metrics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.mapping.config import MapperConfig
from nodes.parameters import parameter_names
from nodes.reader import Reader

GAIN = 0.1  # dB: a doubling of the time that brings less is the end
QUICK_SCENE = "room"  # scene of a quick run: in 30 frames of the real ones COLMAP puts no two images together
EVENLY = 100  # frames that COLMAP gets, about, besides our keyframes and every 5th


@dataclass(frozen=True)
class Ours:
    """A run of the system."""

    report: dict[str, Any]
    track: dict[str, list[Any]]
    frames: dict[int, GroundTruth]
    settings: dict[str, Any] = field(default_factory=dict)  # of the reader

    @property
    def keyframes(self) -> list[int]:
        return [i for i, keyframe in zip(self.track["index"], self.track["keyframe"]) if keyframe]

    @property
    def held_out(self) -> list[int]:
        mapped = set(self.keyframes)
        return [i for i in self.frames if is_held_out(i) and i not in mapped]

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
    asked: float  # seconds; the last iteration ends a little later


def run_ours(scene: str, overrides: list[str], output: Path, made: pieces.Pieces) -> Ours | None:
    """None where the run failed, runs.log in `output` says why, or is not there yet."""
    matrix = Matrix(
        [scene], overrides=[*overrides, "recorder=track", "evaluator.max_frames=2000", "evaluator.max_bytes=2e10"]
    )
    runs = made.runs({str(output.relative_to(made.output)): matrix})
    if not runs or runs[0].report is None or not (runs[0].folder / "track.json").exists():
        return None
    config = OmegaConf.to_container(OmegaConf.load(runs[0].folder / "config.yaml"))
    assert isinstance(config, dict)
    known = parameter_names(Reader.Config)
    settings = {str(k): v for k, v in config["dataset"].items() if k in known}
    track = json.loads((runs[0].folder / "track.json").read_text())
    return Ours(runs[0].report, track, frames_of(settings), settings)


def frames_of(settings: dict[str, Any]) -> dict[int, GroundTruth]:
    messages = Reader(Reader.Config(**settings)).run()
    return {message.index: message for message in messages if isinstance(message, GroundTruth)}


def solve_poses(ours: Ours, place: Path, threads: int, resume: bool) -> tuple[Baseline, list[int]]:
    """COLMAP's model, from the images as they come, and the frames that it got."""
    stride = max(1, round(len(ours.frames) / EVENLY))
    known = {*ours.keyframes, *(i for i in ours.frames if is_held_out(i) or i % stride == 0)}
    if not resume:
        (place / "images.sha256").unlink(missing_ok=True)  # what `solve` would know an earlier model by
    place.mkdir(parents=True, exist_ok=True)
    whole = frames_of({**ours.settings, "size": None})
    items = [Item(i, whole[i].timestamp, whole[i].image, whole[i].intrinsics) for i in sorted(known)]
    return solve(items, place, threads), sorted(known)


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
    return Trained(fitted.seconds, float(psnr), float(ssim), len(fitted.state), fitted.iterations, config.seconds)


def train_longer(model: Model, ours: Ours, longest: float, threads: int, kept: Path) -> list[Trained]:
    """Equal time first, then doubled until the gain is small, to at most `longest` times as long.

    kept: a file of results, from which those of an earlier call, of the same times, are taken; new ones are added.
    """
    known = [Trained(**entry) for entry in json.loads(kept.read_text())] if kept.exists() else []
    if known and not np.isclose(known[0].asked, ours.optimization):
        known = []
    results: list[Trained] = []
    seconds = ours.optimization
    while not converged(results) and seconds <= longest * ours.optimization * 1.001:
        config = SparseConfig(seconds=seconds, mapper=MapperConfig(threads=threads))
        results.append(known[len(results)] if len(results) < len(known) else train(model, ours, config))
        kept.write_text(json.dumps([asdict(result) for result in results]))
        seconds *= 2
    return results


def converged(results: list[Trained]) -> bool:
    """The last doubling of the time gained less than `GAIN`."""
    return len(results) > 1 and results[-1].psnr - results[-2].psnr < GAIN


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
    for doublings, (before, result) in enumerate(zip([None, *trained], trained)):
        name = f"{scene}: map, COLMAP + splatting, " + (f"{2**doublings} times as long" if doublings else "equal time")
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
    if len(trained) > 1:
        gain = trained[-1].psnr - trained[-2].psnr
        name = f"{scene}: COLMAP + splatting, gain by the last doubling of its time"
        rows.append(Row(name, gain, "dB", f"< {GAIN:g}: converged", converged(trained)))
    return rows


def protocol(scene: str, ours: Ours, baseline: Baseline, frames: list[int]) -> Row:
    """What both had, as a row."""
    height, width = next(iter(ours.frames.values())).image.shape[:2]
    text = (
        f"{len(ours.frames)} frames, maps of {len(ours.keyframes)} keyframes at {width}x{height}, scored on "
        f"{len(ours.held_out)} held-out frames; COLMAP got {len(frames)} of the frames at "
        f"{baseline.size[1]}x{baseline.size[0]}"
    )
    return Row(f"{scene}: protocol", text)


def compare(scene: str, options: argparse.Namespace, overrides: list[str], made: pieces.Pieces) -> list[Row]:
    place = made.output / scene
    ours = run_ours(scene, overrides, place / "ours", made)
    if ours is None:
        if f"{scene}/ours" in made.missing:
            return []
        return [Row(f"{scene}: ours", f"failed: see {place / 'ours' / 'runs.log'}", "", "a report", False)]
    threads = options.threads or available_cores()
    resume = options.resume or options.collect
    baseline, frames = solve_poses(ours, place / "colmap", threads, resume)
    rows = [protocol(scene, ours, baseline, frames)]
    if baseline.model is None:
        return [*rows, Row(f"{scene}: COLMAP", baseline.why)]
    rows += pose_rows(scene, ours, baseline.model, frames)
    kept = place / "trained.json"
    if not resume:
        kept.unlink(missing_ok=True)
    try:
        trained = train_longer(baseline.model, ours, options.longest, threads, kept)
    except ValueError as error:
        return [*rows, Row(f"{scene}: map, COLMAP + splatting", str(error))]
    return rows + map_rows(scene, ours, baseline.model, trained)


def measure(options: argparse.Namespace) -> list[Row]:
    scenes = options.scenes.split(",")
    overrides = list(options.overrides)
    if options.quick:
        scenes, options.longest = [QUICK_SCENE], 1.0
        overrides += QUICK
    made = pieces.Pieces.of(options, folder(options, "baselines"))
    rows = [row for scene in scenes for row in compare(scene, options, overrides, made)]
    return rows + made.rows()


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", default="redkitchen,tum_fr1_xyz", help=f"comma separated; --quick: {QUICK_SCENE}")
    parser.add_argument("--longest", type=float, default=8.0, help="times our optimization's time, for the offline one")
    parser.add_argument("--threads", type=int, help="of COLMAP and of the offline optimization; default: all cores")
    pieces.arguments(parser, "dataset.stop=100")


if __name__ == "__main__":
    main(measure, "Baselines on the same frames", arguments)
