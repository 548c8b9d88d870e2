"""The offline map of COLMAP's poses and points: in the way that is its best, at our processor time, and longer.

A way is a choice of training frames, of exposures, of rates and of when these begin to fall. One choice after the
other takes what is best by held-out PSNR: with hindsight, which an offline user does not have.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.baselines.colmap_poses import Model
from bench.baselines.ours import Ours
from bench.baselines.sparse_splats import Posed, SparseConfig, SparseMap
from bench.pieces import Kept
from bench.runs import folder_name
from mvsgs_core import image_metrics
from mvsgs_core.atomic_file import replace_text
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.optimizer import OptimizerConfig

RATES = {  # of places and extents: splats that begin at sparse points need not like what dense ones do; all views are
    # there from the start, so that nothing is bounded as in a stream
    "small": OptimizerConfig(means=5e-4, log_scales=0.03, max_scale_in_stream=1.0),
    "ours": OptimizerConfig(max_scale_in_stream=1.0),
}
GAIN = 0.1  # dB: a doubling of the time that brings less is the end


@dataclass(frozen=True)
class Way:
    """How an offline map is made."""

    frames: str = "keyframes"  # it is trained on: "keyframes", ours, or "all": every one that is not held out
    exposure: str = (
        "none"  # "none"; "trained": an affine a frame; "tracker": the same, beside what our tracker measured
    )
    rates: str = "small"  # learning rates: of `RATES`
    settle: float = 0.5  # last fraction of the time in which they fall

    @property
    def name(self) -> str:
        return f"{self.frames}, exposure {self.exposure}, rates {self.rates}, settles over {self.settle:g}"


@dataclass(frozen=True)
class Trained:
    """One optimization of COLMAP's points: held-out scores after `seconds` of the processor."""

    seconds: float
    psnr: float
    ssim: float
    splats: int
    iterations: int
    asked: float  # seconds; the last iteration ends a little later
    way: str = ""


Train = Callable[[Way, float], Trained]  # in so many processor seconds


def choices(ours: Ours) -> dict[str, tuple[Any, ...]]:
    """What there is of each part of a way, the first ones the start."""
    exposures = ("none", "trained") if ours.exposures is None else ("none", "trained", "tracker")
    return {"frames": ("keyframes", "all"), "exposure": exposures, "rates": tuple(RATES), "settle": (0.5, 0.25, 0.1)}


def train(model: Model, ours: Ours, way: Way, seconds: float, threads: int) -> Trained:
    """Raises ValueError where COLMAP has none of the frames, or no points."""
    poses = dict(zip(model.index.tolist(), model.world_from_cam))
    measured: dict[int, np.ndarray] = ours.exposures or {}

    def posed(index: int) -> Posed:
        frame = ours.frames[index]
        exposure = None if way.exposure == "none" else np.eye(3, 4)
        if way.exposure == "tracker":
            exposure = measured.get(index, exposure)
        return Posed(index, frame.image, frame.intrinsics, poses[index], frame.timestamp, exposure)

    chosen = ours.keyframes if way.frames == "keyframes" else ours.not_held_out
    mapper = MapperConfig(threads=threads, optimizer=RATES[way.rates])
    config = SparseConfig(seconds=seconds, settle=way.settle, mapper=mapper)
    vignetting = ours.vignetting if way.exposure == "tracker" else None
    fitted = SparseMap([posed(i) for i in chosen if i in poses], model.points, model.colors, config, vignetting)
    fitted.optimize()
    psnr, ssim = score((view, fitted.render(view)) for view in (posed(i) for i in ours.scored if i in poses))
    return Trained(fitted.seconds, psnr, ssim, len(fitted.state), fitted.iterations, seconds, way.name)


def score(renders: Any) -> tuple[float, float]:
    """Mean PSNR and SSIM of pairs of a view and its render; NaN of none."""
    scores = []
    for view, color in renders:
        photograph = view.image.astype(np.float32) / 255.0
        scores.append((image_metrics.psnr(color, photograph), image_metrics.ssim(color, photograph)))
    psnr, ssim = np.mean(scores, axis=0) if scores else (np.nan, np.nan)
    return float(psnr), float(ssim)


def kept_in(folder: Path, model: Path, kept: Kept, train: Train) -> Train:
    """`train` that takes what an earlier call left in `folder`, of the same COLMAP model (its file), way and time, and
    leaves what is new there. It trains nothing twice."""
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    folder.mkdir(exist_ok=True)

    @cache
    def found(way: Way, seconds: float) -> Trained:
        file = folder / f"{folder_name(way.name)}_{seconds:.4g}.json"
        asked = {"model": digest, "way": way.name, "seconds": seconds}
        if kept.has(file, asked):
            return Trained(**json.loads(file.read_text()))
        result = train(way, seconds)
        replace_text(file, json.dumps(asdict(result), indent=1))
        kept.keep(file, asked)
        return result

    return found


def best_way(parts: dict[str, tuple[Any, ...]], train: Train, seconds: float) -> tuple[Way, list[Trained]]:
    """The way of the highest PSNR in so much time, found part by part, and what each that was tried reached."""
    best = Way(**{part: values[0] for part, values in parts.items()})
    results = {best: train(best, seconds)}
    for part, values in parts.items():
        for value in values[1:]:
            way = replace(best, **{part: value})
            results[way] = train(way, seconds)
        best = max(results, key=lambda way: np.nan_to_num(results[way].psnr, nan=-np.inf))
    return best, list(results.values())


def train_longer(way: Way, train: Train, seconds: float, longest: float) -> list[Trained]:
    """So much time first, then doubled until the gain is small, to at most `longest` times as long."""
    results: list[Trained] = []
    times = 1.0
    while not converged(results) and times <= longest * 1.001:
        results.append(train(way, times * seconds))
        times *= 2
    return results


def converged(results: Sequence[Trained]) -> bool:
    """The last doubling of the time gained less than `GAIN`."""
    return len(results) > 1 and results[-1].psnr - results[-2].psnr < GAIN
