"""Writes the final trajectory: a recorder for benchmarks that compare with other systems, or draw a run's frames."""

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
    """Trajectory -> a JSON file of its fields; what is not known of a frame, or at all, is null."""

    @dataclass
    class Config:
        path: str = "track.json"  # file to write

    config: Config

    def on_trajectory(self, track: Trajectory) -> None:
        path = Path(self.config.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({name: _plain(value) for name, value in vars(track).items()}, allow_nan=False))

    def on_end(self) -> Iterator[Any]:
        yield from ()


def _plain(value: Any) -> Any:
    """As JSON has it: an array is a list of its rows, a row that is not finite null."""
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind != "f":
        return value.tolist()
    return [row.tolist() if np.isfinite(row).all() else None for row in value]
