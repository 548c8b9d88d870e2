"""Writes which frames became keyframes, and all poses: a recorder for benchmarks that compare with other systems."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from msgs import Trajectory
from nodes import Node


class TrackRecorder(Node):
    """Trajectory -> a JSON file: `index`, `keyframe`, `segment` and `world_from_cam` (null without a pose)."""

    @dataclass
    class Config:
        path: str = "track.json"  # file to write

    config: Config

    def on_trajectory(self, track: Trajectory) -> None:
        known = np.isfinite(track.world_from_cam).all(axis=(1, 2))
        poses = [pose.tolist() if good else None for pose, good in zip(track.world_from_cam, known)]
        content: dict[str, Any] = {
            "index": track.index.tolist(),
            "keyframe": track.keyframe.tolist(),
            "segment": track.segment.tolist(),
            "world_from_cam": poses,
        }
        path = Path(self.config.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))

    def on_end(self) -> Iterator[Any]:
        yield from ()
