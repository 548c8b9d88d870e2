"""Published networks against the weight-free defaults on real video: IterMVS for depth, RAFT-small for the flow.

    python -m bench.learned [--quick] [--json FILE] [--output FOLDER]

Depth: both see the same keyframes, poses, neighbors and ranges, which are the weight-free tracker's; each map is scaled
by its median ratio to the truth. "Filtered" maps went through the same depth fusion. An inlier is within 5 % of the
truth, completeness is the kept part of the true depth. One picture a sequence goes to the folder: photograph, truth,
default, IterMVS, and the latter two filtered. Flow: RMS position error after Sim(3) alignment. Seconds are of the
processor, on one thread.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from bench.depth.data import SOURCES, Scene, Source
from bench.depth.run import Score, depth_view, score
from bench.depth.tracked import load_tracked
from bench.runs import DATA, environment
from bench.runs import folder as folder_of
from bench.table import Row, main, skipped
from bench.tracking.__main__ import run as track
from mvsgs_core import weights
from mvsgs_core.datasets import open_dataset
from mvsgs_core.fusion.fusion import FusionConfig, OnlineFusion
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig, CascadeDepth, OnlineStereo
from mvsgs_core.mvs.learned import LearnedStereo, LearnedStereoConfig
from mvsgs_core.tracking.tracker import TrackerConfig

AREA = 320 * 240  # pixels of a depth map
SCENES = ("fr1_xyz", "redkitchen", "icl_nuim")
QUICK = ("fr1_xyz",)
QUICK_FRAMES = {"depth": 30, "flow": 24}
FLOW_SCENES = ("fr1_xyz", "icl_nuim")


@dataclass(frozen=True)
class Maps:
    """One method's depth of every keyframe."""

    stereo: list[np.ndarray]  # (H, W) float32, 0 where unknown
    filtered: list[np.ndarray]
    seconds: float  # processor, of stereo, a keyframe


def shortened(name: str, frames: int | None) -> str:
    """A sequence's name; cut to its first frames it gets a source of its own."""
    if frames is None:
        return name
    short = f"{name}, {frames} frames"
    SOURCES[short] = replace(SOURCES[name], options=dict(SOURCES[name].options) | {"stop": frames})
    return short


def photographs(scene: Scene, source: Source) -> list[np.ndarray]:
    """The keyframes' images (H, W, 3) uint8, read again."""
    frames = open_dataset(source.dataset, path=DATA / source.folder, **source.options)
    wanted = {view.index for view in scene.views}
    images = {item.index: item.image for item in frames if item.index in wanted}
    return [images[view.index] for view in scene.views]


def run(scene: Scene, images: Sequence[np.ndarray], stereo: OnlineStereo) -> Maps:
    found: list[CascadeDepth] = []
    seconds = 0.0
    for image, view in zip(images, scene.views, strict=True):
        start = time.process_time()
        if isinstance(stereo, LearnedStereo):
            stereo.remember(view.index, image)
        found += stereo.add(view)
        seconds += time.process_time() - start
    start = time.process_time()
    found += stereo.flush()
    seconds += time.process_time() - start
    fusion = OnlineFusion(FusionConfig(threads=1))
    fused = [f for one in found for f in fusion.add(depth_view(one))] + list(fusion.flush())
    return Maps([f.result.depth for f in found], [f.depth for f in fused], seconds / max(1, len(found)))


def depth_rows(name: str, frames: int | None, folder: Path) -> list[Row]:
    short = shortened(name, frames)
    scene = load_tracked(short, AREA)
    images = photographs(scene, SOURCES[short])
    methods = {
        "default": run(scene, images, Cascade(CascadeConfig(area=AREA, threads=1))),
        "IterMVS": run(scene, images, LearnedStereo(LearnedStereoConfig(area=AREA, threads=1))),
    }
    rows = [Row(f"{name}: keyframes", len(scene.views))]
    for method, maps in methods.items():
        rows += _score_rows(f"{name}, {method}", score(maps.stereo, scene, align=True))
        rows += _score_rows(f"{name}, {method}, filtered", score(maps.filtered, scene, align=True))
        rows.append(Row(f"{name}, {method}: processor", maps.seconds, "s a keyframe"))
    file = folder / f"{name}.png"
    if not cv2.imwrite(str(file), picture(scene, images, list(methods.values()))[..., ::-1]):
        raise OSError(f"could not write {file}")
    return rows


def _score_rows(name: str, found: Score) -> list[Row]:
    return [
        Row(f"{name}: abs rel", found.relative_error),
        Row(f"{name}: inliers", found.inliers),
        Row(f"{name}: completeness", found.completeness),
    ]


def picture(scene: Scene, images: Sequence[np.ndarray], methods: Sequence[Maps], width: int = 200) -> np.ndarray:
    """(H, W, 3) uint8: of the keyframe in the middle photograph and truth, then the methods' maps, raw and filtered.

    All in the colors of one range, each map scaled by its median ratio to the truth.
    """
    known = [n for n, truth in enumerate(scene.truths) if truth is not None]
    middle = known[len(known) // 2]
    truth = scene.truths[middle]
    assert truth is not None
    low, high = np.percentile(truth[truth > 0], (2, 98))
    size = (width, round(width * truth.shape[0] / truth.shape[1]))
    panels = [cv2.resize(images[middle], size, interpolation=cv2.INTER_AREA)]
    maps = [truth, *(m.stereo[middle] for m in methods), *(m.filtered[middle] for m in methods)]
    for depth in maps:
        both = (depth > 0) & (truth > 0)
        factor = float(np.median(truth[both] / depth[both])) if both.any() else 1.0
        panels.append(cv2.resize(_colors(depth * factor, low, high), size, interpolation=cv2.INTER_NEAREST))
    return np.hstack(panels)


def _colors(depth: np.ndarray, low: float, high: float) -> np.ndarray:
    """(H, W, 3) uint8 by inverse depth from `low` (red) to `high` (blue); dark gray where unknown."""
    known = depth > 0
    fraction = (1 / np.where(known, depth, high) - 1 / high) / (1 / low - 1 / high)
    colors = cv2.applyColorMap((255 * np.clip(fraction, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(known[..., None], colors, np.uint8(40))


def flow_rows(name: str, frames: int | None) -> list[Row]:
    source = SOURCES[name]
    items = list(islice(open_dataset(source.dataset, path=DATA / source.folder, **source.options), frames))
    rows = []
    for flow in ("lucas_kanade", "raft_small"):
        result = track(items, TrackerConfig(flow=flow))
        error = 100 * result.worst_of_keyframes
        rows.append(Row(f"{name}, {flow}: ATE keyframes", error, f"cm, {result.keyframes} keyframes"))
        rows += result.unknown(f"{name}, {flow}")
        rows.append(Row(f"{name}, {flow}: processor", 1e3 * result.total / len(items), "ms a frame"))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.environ.update(environment())
    folder = folder_of(options, "learned")
    rows: list[Row] = []
    for name in QUICK if options.quick else SCENES:
        if _there(name, "itermvs", rows):
            rows += depth_rows(name, QUICK_FRAMES["depth"] if options.quick else None, folder)
    for name in QUICK if options.quick else FLOW_SCENES:
        if _there(name, "raft_small", rows):
            rows += flow_rows(name, QUICK_FRAMES["flow"] if options.quick else None)
    return rows


def _there(name: str, network: str, rows: list[Row]) -> bool:
    """Whether a sequence and a network's weights are there; if not, a row says what is missing."""
    missing: tuple[Path | str, ...] = ()
    if not (DATA / SOURCES[name].folder).exists():
        missing = (DATA / SOURCES[name].folder,)
    try:
        weights.find(network)
    except FileNotFoundError as error:
        missing = (*missing, str(error))
    rows += [skipped(f"{name}, {network}", why) for why in missing]
    return not missing


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", type=Path, help="folder of the pictures; default: in runs")


if __name__ == "__main__":
    main(measure, "Published networks against the weight-free defaults", arguments)
