"""Readers of image sequences: pure, one file a format, all yielding the same `Item`."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
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


def check(name: str, **options: Any) -> None:
    """Opens a sequence as `open_dataset` does, reads its first frame where it begins with the file's, and closes it.

    Raises what that raises: so it is known before a run starts whether its input can be read. "synthetic" reads nothing
    and takes seconds to make, so of it only the options are looked at.
    """
    reader = _reader(name, options)
    if name == "synthetic":
        return
    try:
        sequence: Sequence = reader(**options)
    except ImportError as error:  # rosbags is optional
        raise ValueError(str(error)) from error
    if not options.get("start"):
        with closing(_frames(sequence)) as frames:
            next(frames)


def open_dataset(name: str, **options: Any) -> Sequence:
    """Opens a sequence: `open_dataset("tum", path=..., start=0, stop=None, stride=1, size=(240, 320))`.

    Raises ValueError for an unknown name or option, FileNotFoundError, saying where the data can be had, for a missing
    path, and BadFileError, a ValueError, for files that are damaged or hostile; iterating raises that where no frame at
    all can be read.
    """
    sequence: Sequence = _reader(name, options)(**options)
    return sequence


def _reader(name: str, options: Mapping[str, Any]) -> Callable[..., Any]:
    if name not in READERS:
        raise ValueError(f"no dataset {name!r}; there are: {', '.join(READERS)}")
    module, _, attribute = READERS[name].partition(":")
    reader: Callable[..., Any] = getattr(importlib.import_module(module), attribute)
    signature = inspect.signature(reader)
    try:
        signature.bind(**options)
    except TypeError as error:
        raise ValueError(f"{name}: {error}; there are: {', '.join(signature.parameters)}") from error
    return reader


def _frames(sequence: Sequence) -> Generator[Item, None, None]:
    yield from sequence
