"""Readers of image sequences: pure, one file a format, all yielding the same `Item`."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Item:
    """One frame of a sequence, undistorted, with what is known of the truth."""

    index: int  # 0, 1, 2, ... in the order delivered, after start, stop and stride
    timestamp: float  # seconds
    image: np.ndarray  # (H, W, 3) uint8 RGB
    intrinsics: np.ndarray  # (4,) float64 fx, fy, cx, cy at this image's size
    world_from_cam: np.ndarray | None = None  # (4, 4) float64
    depth: np.ndarray | None = None  # (H, W) float32, z in the poses' unit, 0 = unknown
    intrinsics_guessed: bool = False  # the focal length is a guess, to be estimated by who can


class Sequence(Protocol):
    """What every reader gives. `warnings` grows while iterating: unreadable images, missing depth, ..."""

    warnings: list[str]

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Item]: ...


READERS = {
    "synthetic": "mvsgs_core.datasets.synthetic:Synthetic",
    "tum": "mvsgs_core.datasets.tum:Tum",
    "replica": "mvsgs_core.datasets.replica:Replica",
    "seven_scenes": "mvsgs_core.datasets.seven_scenes:SevenScenes",
    "icl_nuim": "mvsgs_core.datasets.icl_nuim:IclNuim",
    "images": "mvsgs_core.datasets.images:Images",
    "video": "mvsgs_core.datasets.video:Video",
    "bag": "mvsgs_core.datasets.bag:Bag",
}


def check_path(name: str, path: str | None) -> None:
    """Raises ValueError for an unknown name, and FileNotFoundError, saying where the data can be had, where there is

    nothing at `path` to read it from. Opens nothing; "synthetic" takes no path.
    """
    if name not in READERS:
        raise ValueError(f"no dataset {name!r}; there are: {', '.join(READERS)}")
    layout = getattr(importlib.import_module(READERS[name].partition(":")[0]), "LAYOUT", None)
    if layout is not None:
        layout.present(path)


def open_dataset(name: str, **options: Any) -> Sequence:
    """Opens a sequence: `open_dataset("tum", path=..., start=0, stop=None, stride=1, size=(240, 320))`.

    Raises ValueError for an unknown name and FileNotFoundError, saying where the data can be had, for a missing path.
    """
    if name not in READERS:
        raise ValueError(f"no dataset {name!r}; there are: {', '.join(READERS)}")
    module, _, attribute = READERS[name].partition(":")
    sequence: Sequence = getattr(importlib.import_module(module), attribute)(**options)
    return sequence
