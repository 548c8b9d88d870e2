"""A run of ours that offline peers are compared with, of six small frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.baselines.ours import Ours
from bench.table import Row
from msgs import GroundTruth

NOTHING = np.zeros(0)


def report(psnr: float = 25.0, mapper: float = 3.0) -> dict[str, Any]:
    frames = [{"index": i, "psnr": psnr + i - 5, "held_out": i == 5} for i in (0, 3, 5)]
    return {
        "rendering": {"held_out": {"psnr": psnr, "ssim": 0.8}, "frames": frames},
        "map": {"splats": 1000, "iterations": 90},
        "time": {"cpu": {"tracker": 1.0, "mapper": mapper, "evaluator": 50.0}},
    }


def six_frames(track: dict[str, Any] | None = None, **figures: Any) -> Ours:
    """Frames 0 to 5, of which 0 and 3 are keyframes and 5 is held out."""
    frames = {}
    for i in range(6):
        pose = np.eye(4)
        pose[:3, 3] = (i, i % 2, 0.1 * i)
        gray = np.full((12, 16, 3), 40 * i, np.uint8)
        frames[i] = GroundTruth(i, 0.1 * i, gray, np.array([9.0, 9, 5, 3]), pose, None)
    path = {"index": [0, 3, 5], "keyframe": [True, True, False], "world_from_cam": [None] * 3, **(track or {})}
    return Ours(report(**figures), path, frames, iterations="15 a keyframe")


def by_name(rows: list[Row]) -> dict[str, Row]:
    return {row.name: row for row in rows}
