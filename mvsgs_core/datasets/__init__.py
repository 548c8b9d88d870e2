"""Readers of image sequences: pure, one file a format, all yielding the same `Item`.

A format is a file here whose class is marked with `@dataset`; `dataset=NAME` is the file's name. Where the class has a
static `recognizes(path)`, a path alone is enough to name the format.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Generator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from mvsgs_core.datasets.lens import Lens

R = TypeVar("R")


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
    exposure: float = 0.0  # exposure time times gain over f-number², in a unit that the sequence keeps; 0: not known
    place: np.ndarray | None = None  # (3,) float64 latitude, longitude (degrees), altitude (m) by GPS
    mask: np.ndarray | None = None  # (H, W) bool, False where a pixel is to be ignored; None: all count
    original: np.ndarray | None = None  # (4,) float64 intrinsics before undistortion and scaling; None: of this image


class Sequence(Protocol):
    """What every reader gives. `warnings` grows while iterating: unreadable images, missing depth, ..."""

    warnings: list[str]

    @property
    def lens(self) -> Lens: ...  # of the first frame, at the size that its calibration is for

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Item]: ...


PLAIN = "images"  # the layout that asks for nothing but images, as any other has them
_READERS: dict[str, type] = {}  # of the files that were imported so far


def dataset(reader: type[R]) -> type[R]:
    """Marks the class that reads the format which its file is named after. Its parameters are the format's options."""
    _READERS[reader.__module__.rpartition(".")[2]] = reader
    return reader


def formats() -> list[str]:
    """All there are: what the files of this folder mark."""
    for name in _files():
        importlib.import_module(f"{__name__}.{name}")
    return sorted(_READERS)


def recognized(path: Path) -> list[str]:
    """The formats in whose layout an existing file or folder is, by its names; of what is in it at most the first bytes
    of .mcap files are read.

    A folder of images in no other layout is "images". Raises OSError for a folder that cannot be listed.
    """
    found = [name for name in formats() if getattr(_READERS[name], "recognizes", _nothing)(path)]
    special = [name for name in found if name != PLAIN]
    return special or found


def check(name: str, **options: Any) -> None:
    """Opens a sequence as `open_dataset` does, reads its first frame where it begins with the file's, and closes it.

    Raises what that raises: so it is known before a run starts whether its input can be read. A format without a path
    reads nothing and may take seconds to make, so of it only the options are looked at.
    """
    reader = _reader(name, options)
    if "path" not in inspect.signature(reader).parameters:
        if checked := getattr(reader, "checked", None):
            checked(**options)
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


def options_of(name: str) -> tuple[type, ...]:
    """The dataclasses whose fields are a format's options. Raises ValueError for an unknown format."""
    reader = _reader(name, {})
    found: tuple[type, ...] = getattr(reader, "OPTIONS", (reader,))
    return found


def _nothing(path: Path) -> bool:
    return False


def _files() -> list[str]:
    return [module.name for module in pkgutil.iter_modules(__path__)]


def _reader(name: str, options: Mapping[str, Any]) -> type:
    if name in _files():
        importlib.import_module(f"{__name__}.{name}")
    if name not in _READERS:
        raise ValueError(f"no dataset {name!r}; there are: {', '.join(formats())}")
    reader = _READERS[name]
    signature = inspect.signature(reader)
    try:
        signature.bind(**options)
    except TypeError as error:
        raise ValueError(f"{name}: {error}; there are: {', '.join(signature.parameters)}") from error
    return reader


def _frames(sequence: Sequence) -> Generator[Item, None, None]:
    yield from sequence
