"""Quality and time of the online mapper with true poses and depth, and what each skip and each filter gains.

`python -m bench.mapping [--quick] [--json FILE] [--threads N] [--real FOLDER]`

The synthetic room: 40 keyframes at 320x240, every 3rd frame of 120; held out: a frame of every other gap.
A real sequence (7-Scenes): every 6th frame with its measured depth; held out: the frames between.
What is switched singly runs on fewer keyframes of both. Times are wall times of insertion and optimization, evaluation
excluded; figures of one call were taken on one machine in one run, so that their ratios mean something even where
others use the machine.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from bench.runs import DATA
from bench.table import Row, at_least, at_most, main, skipped
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.fusion.normals import normals_of
from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper

KITCHEN = DATA / "seven_scenes_redkitchen"


@dataclass(frozen=True)
class Scene:
    """Keyframes to map and frames to score."""

    name: str
    views: list[RGBDKeyframe]
    held_out: list[RGBDKeyframe]

    @property
    def label(self) -> str:
        """What was mapped, for the names of rows."""
        height, width = self.views[0].image.shape[:2]
        return f"{self.name}, {len(self.views)} keyframes of {width}x{height}"


@dataclass
class Run:
    """One mapping run: seconds and held-out PSNR at checkpoints; the clock stands still while scoring."""

    seconds: list[float]
    psnr: list[float]
    online_psnr: float
    online_seconds: float
    splats: int
    mapper: OnlineMapper

    def time_to(self, level: float) -> float:
        """Seconds until the held-out PSNR is `level`, linear between checkpoints; inf if never."""
        for k, value in enumerate(self.psnr):
            if value >= level:
                if k == 0 or value == self.psnr[k - 1]:
                    return self.seconds[k]
                fraction = (level - self.psnr[k - 1]) / (value - self.psnr[k - 1])
                return self.seconds[k - 1] + fraction * (self.seconds[k] - self.seconds[k - 1])
        return float("inf")


def room(keyframes: int, size: tuple[int, int]) -> Scene:
    """Every 3rd frame is a keyframe; frame 1 of every other gap is held out."""
    frames = open_dataset("synthetic", scene="room", frames=3 * keyframes, size=size)
    views: list[RGBDKeyframe] = []
    held_out: list[RGBDKeyframe] = []
    for item in frames:
        if item.index % 3 == 0 or item.index % 6 == 1:
            (views if item.index % 3 == 0 else held_out).append(_posed(item))
    return Scene("room", views, held_out)


def kitchen(path: Path, frames: int, size: tuple[int, int]) -> Scene:
    """7-Scenes: frames with depth are the even ones; every 6th is a keyframe, the 3rd after it held out."""
    views: list[RGBDKeyframe] = []
    held_out: list[RGBDKeyframe] = []
    for item in open_dataset("seven_scenes", path=str(path), size=size, stop=frames):
        if item.world_from_cam is None:
            continue
        if item.index % 6 == 0 and item.depth is not None:
            views.append(_posed(item))
        elif item.index % 6 == 3:
            held_out.append(_posed(item))
    return Scene("kitchen", views, held_out)


def _posed(item: Item) -> RGBDKeyframe:
    assert item.world_from_cam is not None
    depth = np.zeros(item.image.shape[:2], dtype=np.float32) if item.depth is None else item.depth
    return RGBDKeyframe(
        item.index, item.image, item.intrinsics, item.world_from_cam, depth, normals=normals_of(depth, item.intrinsics)
    )


def held_out_psnr(mapper: OnlineMapper, scene: Scene) -> float:
    """Mean PSNR over the held-out frames, at their size, without exposure correction."""
    scores = []
    final = mapper.snapshot()
    for view in scene.held_out:
        near = 1e-3 * mapper.frame.length
        color = final.render(view.world_from_cam, view.intrinsics, view.image.shape[:2], near=near).color
        scores.append(psnr(color.clamp(0.0, 1.0).numpy(), view.image.astype(np.float32) / 255.0))
    return float(np.mean(scores))


def run(scene: Scene, config: MapperConfig, checkpoints: int = 10, period: float | None = None) -> Run:
    """Maps the scene: all keyframes, then the refinement, scored `checkpoints` times during the latter.

    period: seconds from one keyframe to the next, for `realtime`; None: a keyframe waits until no iteration is pending.
    """
    mapper = OnlineMapper(config)
    start = time.perf_counter()
    for view in scene.views:
        came = time.perf_counter()
        mapper.add_keyframe(view)
        while period is not None and time.perf_counter() - came < period and mapper.step():
            pass
    while period is None and mapper.step():
        pass
    clock = time.perf_counter() - start
    online = held_out_psnr(mapper, scene)
    seconds, values = [clock], [online]
    refinement = mapper.refinement
    every = max(1, refinement // checkpoints)
    start = time.perf_counter()
    for done in range(refinement):
        mapper.refine(done, refinement)
        if (done + 1) % every == 0 or done + 1 == refinement:
            clock += time.perf_counter() - start
            seconds.append(clock)
            values.append(held_out_psnr(mapper, scene))
            start = time.perf_counter()
    return Run(seconds, values, online, seconds[0], len(mapper.state), mapper)


def all_skips_off(config: MapperConfig) -> MapperConfig:
    """Every keyframe's every pixel inserted (in rectangles), every iteration whole."""
    return replace(
        config,
        convergence=replace(config.convergence, skip=False),
        training=replace(config.training, selective=False),
        insertion=replace(config.insertion, unexplored=False),
    )


def variants(config: MapperConfig) -> dict[str, MapperConfig]:
    """The default with one thing switched."""
    insertion, convergence, density = config.insertion, config.convergence, config.density_control
    training = config.training
    return {
        "no unexplored mask": replace(config, insertion=replace(insertion, unexplored=False)),
        "unexplored below 40 dB (paper)": replace(config, insertion=replace(insertion, price=0.11, median_errors=0.0)),
        "splats without a price": replace(config, insertion=replace(insertion, price=0.0)),
        "whole error": replace(config, insertion=replace(insertion, median_errors=0.0)),
        "nothing added where the map shows something": replace(
            config, insertion=replace(insertion, median_errors=float("inf"))
        ),
        "density control none": replace(config, density_control=replace(density, mode="none")),
        "no skip of converged keyframes": replace(config, convergence=replace(convergence, skip=False)),
        "every splat stepped": replace(config, training=replace(training, selective=False)),
        "shapes trained (exact)": replace(config, training=replace(training, kernel="exact", betas=True)),
        "harmonics of degree 1": replace(config, sh_degree=1),
        "poses trained": replace(config, training=replace(training, refine_poses=True)),
    }


def singly(scene: Scene, config: MapperConfig) -> list[Row]:
    """Splats, seconds and PSNR of the default and of every variant of it; half the refinement."""
    config = replace(config, refinement=config.refinement_of(len(scene.views)) // 2)
    default = run(scene, config, checkpoints=1)
    rows = rows_of(scene, "default", default)
    for name, variant in variants(config).items():
        rows += rows_of(scene, name, run(scene, variant, checkpoints=1))
    budget = 0.5 * default.online_seconds / len(scene.views)
    live = run(scene, replace(config, realtime=True), checkpoints=1, period=budget)
    return rows + rows_of(scene, "realtime, keyframes come twice as fast", live)


def rows_of(scene: Scene, name: str, result: Run) -> list[Row]:
    prefix = f"{scene.label}, {name}"
    return [
        Row(f"{prefix}: held-out PSNR", result.psnr[-1], "dB"),
        Row(f"{prefix}: before refinement", result.online_psnr, "dB"),
        Row(f"{prefix}: time", result.seconds[-1], "s"),
        Row(f"{prefix}: splats", result.splats),
        Row(f"{prefix}: iterations", result.mapper.iterations),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    torch.set_num_threads(options.threads)
    quick = options.quick
    size = (120, 160) if quick else (240, 320)
    config = MapperConfig()
    if quick:
        config = replace(config, iterations=10, refinement=60)
    if options.iterations is not None:
        config = replace(config, iterations=options.iterations)
    if options.refinement is not None:
        config = replace(config, refinement=options.refinement)
    config = replace(config, threads=options.threads)
    scene = room(10 if quick else options.keyframes, size)
    off = run(scene, all_skips_off(config))
    level = 0.95 * off.psnr[-1]
    rows = [
        *rows_of(scene, "all skips off", off),
        Row(f"{scene.label}, all skips off: time to 95 % of its final PSNR", off.time_to(level), "s"),
    ]
    result = run(scene, config)
    rows += rows_of(scene, "default", result)
    if not quick:
        rows.append(at_least(f"{scene.label}, default: held-out PSNR, as a goal", result.psnr[-1], "dB", 30.0))
    ratio, gain = result.time_to(level) / off.time_to(level), result.psnr[-1] - off.psnr[-1]
    rows += [
        Row(f"{scene.label}, default: time to that PSNR", result.time_to(level), "s"),
        at_most(f"{scene.label}, default: ratio of these times", ratio, "", 0.4),
        at_least(f"{scene.label}, default: final PSNR minus all off", gain, "dB", -0.2),
    ]
    if quick:
        return rows
    rows += singly(room(options.ablation_keyframes, size), config)
    if options.real.exists():
        rows += singly(kitchen(options.real, 6 * options.ablation_keyframes, size), config)
    else:
        rows.append(skipped("kitchen", options.real))
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keyframes", type=int, default=40)
    parser.add_argument("--iterations", type=int, help="budget of a keyframe; default: the mapper's")
    parser.add_argument("--refinement", type=int, help="default: the mapper's")
    parser.add_argument("--real", type=Path, default=KITCHEN, help="7-Scenes RedKitchen")
    parser.add_argument("--ablation-keyframes", type=int, default=10, help="of each scene, for what is switched singly")


if __name__ == "__main__":
    main(measure, "Online mapping with true poses and depth", arguments)
