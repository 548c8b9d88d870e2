"""Renders the map at the poses of the run and scores the renders against the photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from mvsgs_core.camera import resize_image
from mvsgs_core.evaluation import metrics
from mvsgs_core.evaluation.frames import ENDING
from mvsgs_core.held_out import is_held_out
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats

Compare = Callable[[np.ndarray, np.ndarray], float]  # of a render and the photograph, (H, W, 3) float32 in 0..1


@dataclass(frozen=True)
class ScoredFrame:
    """A frame to score, at its native resolution."""

    index: int
    keyframe: bool
    world_from_cam: np.ndarray  # (4, 4) in the map's frame
    intrinsics: np.ndarray  # (4,)
    photograph: Callable[[], np.ndarray]  # (H, W, 3) uint8, read when needed
    near: float  # nothing nearer is drawn, map units
    readout: np.ndarray | None = None  # (6,) twist of the camera while it was read, see `rasterize`; None: all at once
    exposure: np.ndarray | None = None  # (3, 4) color affine of the photograph; None: none
    vignetting: np.ndarray | None = None  # (3,) of the sensor; None: none
    antialiased: bool = False  # as its map is rendered, see `rasterize`
    background: np.ndarray | None = None  # (3,) of its map; None: black
    mask: Callable[[], np.ndarray | None] = lambda: None  # (H, W) bool, the pixels that count, read when needed
    reads_columns: bool = False  # while it was read, not rows, see `rasterize`

    @property
    def shows(self) -> bool:
        """Whether its mask leaves a pixel that counts."""
        mask = self.mask()
        return mask is None or bool(mask.any())


@dataclass(frozen=True)
class Score:
    index: int
    keyframe: bool
    figures: dict[str, float | None]  # by key of metrics.IMAGE
    coverage: float  # fraction of the pixels at which the render is more opaque than not
    fitted: dict[str, float | None] | None = None  # figures with the camera fitted at test time; None: it was not

    @property
    def held_out(self) -> bool:
        """The map was not made of it: held out before the run, and no keyframe."""
        return not self.keyframe and is_held_out(self.index)

    @property
    def kind(self) -> str:
        return "keyframe" if self.keyframe else "held out" if self.held_out else "between keyframes"

    def entry(self) -> dict[str, Any]:
        """As it stands in report.json."""
        own = {"index": self.index, "keyframe": self.keyframe, "coverage": self.coverage}
        return {**own, **self.figures, "held_out": self.held_out, "kind": self.kind, "fitted": self.fitted}

    @property
    def rank(self) -> float:
        """The higher, the better the frame, by the first of the image metrics."""
        first = metrics.IMAGE[0]
        value = self.figures[first.key]
        assert value is not None
        return value if first.better == "higher" else -value


class DepthRange(NamedTuple):
    """Depths at the ends of a scale of colors."""

    near: float
    far: float

    def at(self, part: float) -> float:
        """The depth so far along the scale, 0 to 1: even steps are those of inverse depth."""
        return 1.0 / ((1.0 - part) / self.near + part / self.far)


class Rendered(NamedTuple):
    color: np.ndarray  # (H, W, 3) float32 in 0..1, as the frame's exposure, shutter and vignetting show it
    depth: np.ndarray  # (H, W) float32, 0 where nothing is rendered
    opacity: np.ndarray  # (H, W) float32 in 0..1


def render_frame(splats: Splats, kernel: str, frame: ScoredFrame, size: tuple[int, int]) -> Rendered:
    """What the map shows from the frame, at (height, width)."""
    exposure = None if frame.exposure is None else torch.from_numpy(frame.exposure)
    with torch.inference_mode():
        render = rasterize(
            splats, frame.world_from_cam, frame.intrinsics, size, exposure=exposure, kernel=kernel, near=frame.near,
            readout=frame.readout, reads_columns=frame.reads_columns, antialiased=frame.antialiased,
            background=frame.background,
        )  # fmt: skip
    color = render.color.cpu().numpy()
    if frame.vignetting is not None:
        color = color * vignetting_factor(frame.vignetting, frame.intrinsics, size)[..., None]
    return Rendered(color.clip(0.0, 1.0), render.depth.cpu().numpy(), render.opacity.cpu().numpy())


def score_frame(splats: Splats, kernel: str, frame: ScoredFrame, given: Mapping[str, Compare] | None = None) -> Score:
    """Scores one frame by metrics.IMAGE; given: those of them that are made at run time, by key. Nothing is fitted to
    its photograph, exposure neither.

    Pixels that the frame's mask leaves out count for nothing: the photograph is there what the render is, and figures
    are means over the rest."""
    photograph, mask = frame.photograph().astype(np.float32) / 255.0, frame.mask()
    color, _, opacity = render_frame(splats, kernel, frame, photograph.shape[:2])
    given, part = given or {}, 1.0
    if mask is not None:
        photograph, part = np.where(mask[..., None], photograph, color), float(mask.mean())
    pair = (color, photograph) if mask is None else (color, photograph, mask)
    figures = {m.key: None if m.of is None else m.of(*pair) for m in metrics.IMAGE if m.key not in given}
    figures |= {key: compare(color, photograph) / part for key, compare in given.items()}
    shown = opacity > 0.5
    return Score(frame.index, frame.keyframe, figures, float((shown if mask is None else shown[mask]).mean()))


def choose(frames: list[ScoredFrame], limit: int) -> list[ScoredFrame]:
    """All frames, in the order of the stream, or where there are more than `limit` as many of each kind, spread evenly
    over the run, and its last ones: the last, and of many the last few, for the end of a stream is where maps fail."""
    if len(frames) <= limit:
        return frames
    last = min(ENDING, max(1, limit // 20))
    chosen, rest = frames[-last:], frames[:-last]
    groups = [
        [f for f in rest if f.keyframe],
        [f for f in rest if not f.keyframe and is_held_out(f.index)],
        [f for f in rest if not f.keyframe and not is_held_out(f.index)],
    ]
    for k, group in enumerate(groups):
        wanted = (limit - len(chosen)) // (len(groups) - k)
        places = np.linspace(0, max(len(group) - 1, 0), min(wanted, len(group)))
        chosen += [group[i] for i in np.unique(places.round().astype(int))]
    return sorted(chosen, key=lambda f: f.index)


def summarize(scores: Iterable[Score]) -> dict[str, Any]:
    """Means over keyframes (training views), held-out frames (never mapped) and all frames scored, with their number;
    the worst of each by PSNR; how much of the frames the map covers; each frame.

    "held_out" is the strict protocol, "held_out_fitted" that with cameras fitted at test time."""
    scores = list(scores)
    keyframes, held_out = [s for s in scores if s.keyframe], [s for s in scores if s.held_out]
    return {
        "keyframes": _mean([s.figures for s in keyframes]),
        "held_out": _mean([s.figures for s in held_out]),
        "held_out_fitted": _mean([s.fitted for s in held_out if s.fitted is not None]),
        "all": _mean([s.figures for s in scores]),
        "generalization_gap": _gap(keyframes, held_out),
        "worst": {
            "held_out": worst_of(held_out).entry() if held_out else None,
            "all": worst_of(scores).entry() if scores else None,
        },
        "coverage": _coverage(scores),
        "frames": [s.entry() for s in scores],
    }


def worst_of(scores: Sequence[Score]) -> Score:
    return min(scores, key=lambda s: s.rank)


def _coverage(scores: Sequence[Score]) -> dict[str, Any]:
    if not scores:
        return {"mean": None, "min": None, "min_index": None, "count": 0}
    least = min(scores, key=lambda s: s.coverage)
    mean = float(np.mean([s.coverage for s in scores]))
    return {"mean": mean, "min": least.coverage, "min_index": least.index, "count": len(scores)}


def _mean(figures: Sequence[Mapping[str, float | None]]) -> dict[str, float | int | None]:
    means: dict[str, float | int | None] = {}
    for metric in metrics.IMAGE:
        values = [value for of_frame in figures if (value := of_frame[metric.key]) is not None]
        means[metric.key] = float(np.mean(values)) if values else None
    return means | {"count": len(figures)}


def _gap(keyframes: Sequence[Score], held_out: Sequence[Score]) -> float | None:
    """By how much training views are better than held-out frames, by the first of the image metrics."""
    if not keyframes or not held_out:
        return None
    return float(np.mean([s.rank for s in keyframes]) - np.mean([s.rank for s in held_out]))


def comparison(
    splats: Splats, kernel: str, frame: ScoredFrame, width: int = 640
) -> tuple[dict[str, np.ndarray], DepthRange | None]:
    """Pictures (h, w, 3) uint8 of a frame for the report, `width` pixels wide at most: photograph, render, error,
    rendered depth; and what the colors of the last mean."""
    photograph = frame.photograph()
    color, depth, _ = render_frame(splats, kernel, frame, photograph.shape[:2])
    width = min(width, photograph.shape[1])
    size = (max(1, round(photograph.shape[0] * width / photograph.shape[1])), width)
    error, mask = np.abs(color - photograph.astype(np.float32) / 255.0).mean(axis=2), frame.mask()
    if mask is not None:
        error[~mask] = 0.0
    pictures = {
        "photograph": photograph,
        "render": (color * 255).round().astype(np.uint8),
        "error (x4)": colorize(np.clip(error * 4, 0, 1)),
        "rendered depth": colorize_depth(depth),
    }
    return {name: resize_image(picture, size) for name, picture in pictures.items()}, depth_range(depth)


def colorize(values: np.ndarray) -> np.ndarray:
    """(H, W) in 0..1 to (H, W, 3) uint8 RGB: black, red, yellow, white."""
    v = np.clip(np.nan_to_num(values), 0, 1)[..., None] * 3
    return (np.clip(v - np.array([0.0, 1.0, 2.0]), 0, 1) * 255).astype(np.uint8)


def colorize_depth(depth: np.ndarray) -> np.ndarray:
    """(H, W) depth, 0 unknown, to (H, W, 3) uint8 by inverse depth: near red, far blue, unknown dark gray."""
    known, inverse, (low, high) = _inverse(depth)
    if known.any():
        inverse = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
    picture = cv2.applyColorMap((inverse * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(known[..., None], picture, np.uint8(40))


def depth_range(depth: np.ndarray) -> DepthRange | None:
    """What the ends of `colorize_depth` mean for this depth map, in its unit; None where nothing is known."""
    known, _, (low, high) = _inverse(depth)
    return DepthRange(1.0 / high, 1.0 / low) if known.any() else None


def depth_colors(count: int) -> list[str]:
    """Of `colorize_depth`, from the nearest to the farthest, as in a style sheet: even steps of inverse depth."""
    steps = np.linspace(255, 0, count).round().astype(np.uint8)[:, None]
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in cv2.applyColorMap(steps, cv2.COLORMAP_TURBO)[:, 0].tolist()]


def _inverse(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Where a depth map is known, its inverse (H, W) there, and the range of that without the outermost percent."""
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.zeros(depth.shape, np.float32)
    inverse[known] = 1.0 / depth[known]
    low, high = np.percentile(inverse[known], [1, 99]) if known.any() else (0.0, 0.0)
    return known, inverse, (float(low), float(high))
