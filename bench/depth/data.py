"""Posed keyframes with true depth, for the depth benchmark: real, rendered and synthetic."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np

from bench.runs import DATA
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe

COARSE = (30, 40)  # cells of the simulated tracker grid


@dataclass(frozen=True)
class Source:
    """A sequence and how its keyframes are chosen."""

    dataset: str
    options: dict[str, Any] = field(default_factory=dict)
    folder: str = ""  # below ../shared/data
    tolerance: float = 0.05  # relative depth error of an inlier
    parallax: float = 0.06  # baseline over median depth between keyframes
    stride: int = 1  # frames that are looked at
    ragged: bool = False  # its depth maps have wrong values along edges and in the far: not scored


SOURCES = {
    "room": Source("synthetic", {"scene": "room", "frames": 120, "threads": 2}, tolerance=0.02),
    "room_b": Source("synthetic", {"scene": "room", "frames": 120, "threads": 2, "seed": 5}, tolerance=0.02),
    "aerial": Source("synthetic", {"scene": "aerial", "frames": 80, "threads": 2}, tolerance=0.02),
    "town": Source("synthetic", {"scene": "town", "frames": 160, "threads": 2}),
    "redkitchen": Source("seven_scenes", folder="seven_scenes_redkitchen"),
    "fr1_xyz": Source("tum", folder="tum_fr1_xyz"),
    "replica": Source("replica", folder="replica/room0_20f", tolerance=0.05, parallax=0.01, stride=2),
    "icl_nuim": Source("icl_nuim", folder="icl_nuim_of_kt0", tolerance=0.05, parallax=0.02, ragged=True),
}


@dataclass(frozen=True)
class Scene:
    """Keyframes of a sequence, ready for stereo, with what is true."""

    name: str
    items: list[Item]
    views: list[StereoKeyframe]
    truths: list[np.ndarray | None]  # (H, W) float32 at the views' size, 0 = unknown
    tolerance: float


def load_scene(
    name: str, area: int, count: int | None = None, scales: tuple[int, ...] = (1, 2), **changes: Any
) -> Scene:
    """Keyframes at a fixed parallax, at most `count`; `changes` to the reader's options.

    Raises FileNotFoundError where the data is missing.
    """
    source = SOURCES[name]
    options = source.options | changes
    if source.dataset == "synthetic":
        options["size"] = rendered_size(area)
    else:
        options |= {"path": DATA / source.folder, "stride": source.stride}
    frames: Iterable[Item] = open_dataset(source.dataset, **options)
    if source.ragged:
        frames = (replace(f, depth=None if f.depth is None else without_ragged_edges(f.depth)) for f in frames)
    items = list(islice(keyframes(frames, source.parallax), count))
    known = [i.depth for i in items if i.depth is not None]
    views, truths = [], []
    for number, item in enumerate(items):
        coarse_from = item.depth if item.depth is not None else known[min(number // 2, len(known) - 1)]
        grid, weight = coarse_grid(coarse_from, seed=number)
        view = prepare_keyframe(
            item.index, item.image, item.intrinsics, _pose(item), area=area, scales=scales,
            inverse_depth=grid, weight=weight,
        )  # fmt: skip
        views.append(view)
        size = (view.size[1], view.size[0])
        truths.append(None if item.depth is None else cv2.resize(item.depth, size, interpolation=cv2.INTER_NEAREST))
    return Scene(name, items, views, truths, source.tolerance)


def rendered_size(area: int) -> tuple[int, int]:
    """Height and width of a rendered scene for depth maps of so many pixels."""
    return (240, 320) if area <= 320 * 240 else (384, 512)


def _pose(item: Item) -> np.ndarray:
    if item.world_from_cam is None:
        raise ValueError(f"frame {item.index} has no pose")
    return item.world_from_cam


def keyframes(frames: Iterable[Item], parallax: float) -> Iterable[Item]:
    """Frames `parallax` times the median depth, or 12 degrees, from the last one; with depth where the set has some.

    The last known median depth stands in for frames without depth.
    """
    last: np.ndarray | None = None
    median = 0.0
    skipped = 0
    for frame in frames:
        if frame.world_from_cam is None:
            continue
        if frame.depth is None and skipped < 3 and last is not None:
            skipped += 1
            continue
        skipped = 0
        if frame.depth is not None and (frame.depth > 0).any():
            median = float(np.median(frame.depth[frame.depth > 0]))
        if median == 0.0:
            continue
        pose = frame.world_from_cam
        if last is not None:
            moved = np.linalg.norm(pose[:3, 3] - last[:3, 3]) / median
            turned = np.arccos(np.clip((np.trace(pose[:3, :3].T @ last[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            if moved < parallax and turned < np.radians(12.0):
                continue
        last = pose
        yield frame


def without_ragged_edges(depth: np.ndarray) -> np.ndarray:
    """0 where a depth (H, W) is 30 % off the median of its 5x5 pixels, or below a twentieth of the image's median."""
    around = cv2.medianBlur(depth, 5)
    good = (np.abs(depth - around) < 0.3 * around) & (depth > 0.05 * np.median(depth[depth > 0]))
    return np.where(good, depth, 0.0).astype(np.float32)


def coarse_grid(
    depth: np.ndarray, seed: int, known: float = 0.5, noise: float = 0.1, outliers: float = 0.03
) -> tuple[np.ndarray, np.ndarray]:
    """What a tracker would know: half of the cells, 10 % noise, 3 % wrong by up to a factor of 3; and weights."""
    rng = np.random.default_rng(seed)
    cells = cv2.resize(depth, (COARSE[1], COARSE[0]), interpolation=cv2.INTER_NEAREST)
    inverse = np.where(cells > 0, 1.0 / np.where(cells > 0, cells, 1.0), 0.0)
    inverse *= np.exp(noise * rng.normal(size=COARSE))
    wrong = rng.random(COARSE) < outliers
    inverse = np.where(wrong, inverse * 3.0 ** rng.uniform(-1, 1, COARSE), inverse)
    inverse *= rng.random(COARSE) < known
    return inverse.astype(np.float32), (inverse > 0).astype(np.float32)
