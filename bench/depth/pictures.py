"""Pictures of a sequence's depth maps: image, truth, unfiltered, filtered and error, one keyframe a row."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bench.depth.data import Scene
from bench.depth.run import Run, scaled_to

_UNKNOWN = (40, 40, 40)


def write_pictures(scene: Scene, found: Run, folder: Path, align: bool, count: int = 4) -> Path:
    """A PNG with `count` keyframes. Near is yellow. Error: green within the tolerance, red at three times it."""
    folder.mkdir(parents=True, exist_ok=True)
    usable = [k for k, truth in enumerate(scene.truths) if truth is not None]
    rows = []
    for k in [usable[i] for i in np.linspace(0, len(usable) - 1, min(count, len(usable))).round().astype(int)]:
        truth = scene.truths[k]
        assert truth is not None
        raw, kept = found.stereo[k].result.depth, found.fused[k].depth
        if align:
            raw, kept = (scaled_to(depth, truth) for depth in (raw, kept))
        known = truth[truth > 0]
        span = (float(np.percentile(1.0 / known, 1)), float(np.percentile(1.0 / known, 99)))
        image = np.clip(scene.views[k].gray(1) + 128.0, 0, 255).astype(np.uint8)
        rows.append(
            np.hstack(
                [
                    cv2.cvtColor(image, cv2.COLOR_GRAY2BGR),
                    *(_colored(depth, span) for depth in (truth, raw, kept)),
                    _error(kept, truth, scene.tolerance),
                ]
            )
        )
    file = folder / f"{scene.name.replace(', ', '_')}.png"
    cv2.imwrite(str(file), np.vstack(rows))
    return file


def _colored(depth: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    known = depth > 0
    inverse = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
    level = np.clip((inverse - span[0]) / max(span[1] - span[0], 1e-9), 0.0, 1.0)
    colors = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_INFERNO)
    colors[~known] = _UNKNOWN
    return np.asarray(colors)


def _error(depth: np.ndarray, truth: np.ndarray, tolerance: float) -> np.ndarray:
    both = (depth > 0) & (truth > 0)
    relative = np.where(both, np.abs(depth - truth) / np.where(both, truth, 1.0), 0.0)
    fraction = np.clip((relative / tolerance - 1.0) / 2.0, 0.0, 1.0)
    colors = np.stack([np.zeros_like(fraction), 200 * (1.0 - fraction), 255 * fraction], axis=-1).astype(np.uint8)
    colors[~both] = _UNKNOWN
    return np.asarray(colors)
