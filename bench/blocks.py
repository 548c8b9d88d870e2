"""The final refinement in blocks, on a Ray cluster of two nodes, against the whole map's: `python -m bench.blocks`.

A map is made of true poses, once, and refined from there in each way, an image as often in all. How long that takes
with one core and with two nodes of a core each, and the held-out frames: of all pixels, and of those where splats of
two blocks meet. Times mean something on an idle machine of two cores or more only.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from bench.ray_nodes import ray_nodes
from bench.runs import DATA
from bench.table import Row, at_least, main, names, skipped, timed
from launch.compose import compose
from launch.inline import run_inline
from msgs import Frame, GroundTruth
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.held_out import is_held_out
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.blocks import job
from mvsgs_core.mapping.blocks.config import RefineConfig
from mvsgs_core.mapping.blocks.refinement import together
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.named_modules import is_installed
from mvsgs_core.rasterizer.spherical_harmonics import C0
from nodes import Node
from nodes.mapper import Mapper

SMALL = ["dataset=synthetic", "dataset.size=[120,160]"]
MAPS = {  # overrides of each
    "town": [*SMALL, "dataset.options.scene=town", "dataset.options.frames=960"],
    "room": SMALL,
    "long_town": [*SMALL, "dataset.options.scene=town", "dataset.options.frames=2400"],
    "kitti_piece": ["dataset=tum", f"dataset.path={DATA / 'kitti_piece'}", "dataset.size=[93,307]"],
}
USUAL = ["town", "room", "kitti_piece"]  # the long one takes a quarter of an hour
TIMED = ("town", "long_town")  # where most keyframes see one block only
MEET = 0.95  # of a pixel's light that one block's splats have, at most, where two meet
SPEED = 1.7  # times as fast with two nodes
SEAM = 0.2  # dB that the pixels where blocks meet may lose


@dataclass(frozen=True)
class Photograph:
    """A held-out frame."""

    image: np.ndarray  # (H, W, 3) uint8
    intrinsics: np.ndarray  # (4,)
    world_from_cam: np.ndarray  # (4, 4)


def made(overrides: list[str]) -> tuple[Atlas, list[Photograph]]:
    """A map that is not refined, and the frames that were held out."""
    frames: dict[int, Frame] = {}
    poses: dict[int, np.ndarray] = {}

    def observe(slot: str, node: Node, message: object) -> None:
        if isinstance(message, Frame) and is_held_out(message.index):
            frames[message.index] = message
        if isinstance(message, GroundTruth) and message.world_from_cam is not None:
            poses[message.index] = message.world_from_cam

    own = ["tracker=ground_truth", "mapper.refinement=0", "mapper.threads=1", "evaluator=off", "inline=true"]
    mapper = run_inline(compose([*overrides, *own]), observe)["mapper"]
    assert isinstance(mapper, Mapper)
    return mapper.atlas, [
        Photograph(frames[k].image, frames[k].intrinsics, poses[k]) for k in sorted(frames.keys() & poses.keys())
    ]


def refined(
    begun: Atlas, refine: RefineConfig, total: int, clock: Callable[[], float] = time.perf_counter
) -> tuple[OnlineMapper, float]:
    """A copy of the map, refined in this way, and the seconds that it took."""
    atlas = begun.frozen()
    mapper = atlas.current
    mapper.config = replace(mapper.config, refinement=total, refine=refine)
    start = clock()
    while atlas.refine():
        pass
    return mapper, clock() - start


def longest(begun: Atlas, blocks: int, total: int) -> float:
    """Seconds of the processor that refinement in blocks takes where each has a core: what is done before and after,
    over the whole map too, and the block that takes longest."""
    mapper = begun.frozen().current
    start = time.process_time()
    parting = job.parting_of(mapper, blocks)
    parts = job.iterations_of(mapper, parting, total)
    jobs = [job.job_of(mapper, parting, b, n, together(n, len(parts))) for b, n in enumerate(parts)]
    ends, results = [time.process_time()], []
    for each in jobs:
        results += [result for result in job.refined(each, job.plain(mapper.config)) if result is not None]
        ends.append(time.process_time())
    job.merge(mapper, results)
    for done in range(total - together(total, len(parts)), total):
        mapper.refine(done, total)
    return time.process_time() - ends[-1] + ends[0] - start + float(np.diff(ends).max())


def borders(mapper: OnlineMapper, blocks: int, photographs: list[Photograph]) -> list[np.ndarray]:
    """(H, W) bool of each photograph: where splats of two blocks make a pixel, and the pixels around."""
    snapshot, owner = mapper.snapshot(), job.parting_of(mapper, blocks).owner
    colors = torch.zeros_like(snapshot.splats.sh)
    colors[:, 0] = torch.from_numpy(np.eye(3, dtype=np.float32)[owner % 3] - 0.5) / C0
    parts = replace(snapshot, splats=replace(snapshot.splats, sh=colors))
    found = []
    for photograph in photographs:
        light = parts.render(photograph.world_from_cam, photograph.intrinsics, photograph.image.shape[:2]).color.numpy()
        meet = light.max(axis=-1) < MEET * light.sum(axis=-1)
        found.append(cv2.dilate(meet.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    return found


def errors(snapshot: Snapshot, photographs: list[Photograph]) -> list[np.ndarray]:
    """(H, W) squared error, mean over colors, of each photograph."""
    found = []
    for photograph in photographs:
        size = photograph.image.shape[:2]
        color = snapshot.render(photograph.world_from_cam, photograph.intrinsics, size).color.clamp(0, 1).numpy()
        found.append(((color - photograph.image / 255.0) ** 2).mean(axis=-1))
    return found


def decibels(squared: list[np.ndarray], where: list[np.ndarray] | None = None) -> float:
    """Of all these pixels together."""
    chosen = squared if where is None else [error[mask] for error, mask in zip(squared, where)]
    return float(-10 * np.log10(np.concatenate([error.ravel() for error in chosen]).mean()))


def compared(name: str, begun: Atlas, photographs: list[Photograph], total: int, rounds: int) -> list[Row]:
    """rounds: of timing, with Ray; 0: blocks one after the other, without."""
    before = begun.current
    whole, seconds = refined(begun, RefineConfig(), total, time.process_time)
    parted, faster = refined(begun, RefineConfig(blocks=2), total)[0], seconds / longest(begun, 2, total)
    where, shown = borders(before, 2, photographs), [m.snapshot() for m in (before, whole, parted)]
    first, one, two = (errors(snapshot, photographs) for snapshot in shown)
    lost = decibels(two, where) - decibels(one, where)
    rows = [
        Row(f"{name}: keyframes", len(before.views)),
        Row(f"{name}: splats", len(before.state)),
        Row(f"{name}: iterations of the whole map", total),
        Row(f"{name}: iterations of the blocks, together", parted.iterations - before.iterations),
        Row(f"{name}: pixels where blocks meet", 100 * float(np.mean([mask.mean() for mask in where])), "%"),
        Row(f"{name}: held-out PSNR before", decibels(first), "dB"),
        Row(f"{name}: held-out PSNR, whole", decibels(one), "dB"),
        Row(f"{name}: held-out PSNR, blocks", decibels(two), "dB"),
        Row(f"{name}: where blocks meet, before", decibels(first, where), "dB"),
        Row(f"{name}: where blocks meet, whole", decibels(one, where), "dB"),
        at_least(f"{name}: where blocks meet, blocks less whole", lost, "dB", -SEAM),
        Row(f"{name}: times as fast, of the processor's time", faster),
    ]
    return rows + (timed_rows(name, begun, total, rounds) if rounds else [])


def timed_rows(name: str, begun: Atlas, total: int, rounds: int) -> list[Row]:
    alone, parted = [], []
    known = set(begun.current.log.warnings)
    with ray_nodes(2) as address:
        for _ in range(rounds):
            alone.append(refined(begun, RefineConfig(), total)[1])
            mapper, seconds = refined(begun, RefineConfig(by="ray", address=address), total)
            if new := [warning for warning in mapper.log.warnings if warning not in known]:
                raise RuntimeError(new[0])  # that it was refined here, as the cluster failed
            parted.append(seconds)
    faster = [one / two for one, two in zip(alone, parted)]
    return [
        timed(f"{name}: one process of one core", alone, "s"),
        timed(f"{name}: two nodes of one core", parted, "s"),
        timed(f"{name}: times as fast", faster, "", minimum=SPEED),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    chosen = ["town"] if options.quick else options.maps
    rows, rounds = [], options.rounds if is_installed("ray") else 0
    for name in chosen:
        if name == "kitti_piece" and not (DATA / name).exists():
            rows.append(skipped(name, DATA / name))
            continue
        begun, photographs = made([*MAPS[name], *(["dataset.stop=60"] if options.quick else [])])
        total = 60 if options.quick else options.iterations
        rows += compared(name, begun, photographs, total, rounds if name in TIMED else 0)
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--maps", type=names(MAPS), default=USUAL, help="of " + ", ".join(MAPS))
    parser.add_argument("--iterations", type=int, default=600, help="of the whole map's refinement")
    parser.add_argument("--rounds", type=int, default=3, help="of timing; 0: none")


if __name__ == "__main__":
    main(measure, "The final refinement in blocks", arguments)
