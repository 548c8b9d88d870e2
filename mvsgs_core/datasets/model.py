"""A calibrated photo set, whatever wrote it: each image's lens and, where known, its pose."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.files import read_numbers
from mvsgs_core.datasets.lens import Lens

_ANY = re.compile(r"(images|rgb|input|frames|color)(_\d+)?")  # folders whose name says nothing of what is in them
_FARTHEST = 1e12  # in the file's own unit: the Earth's radius is 6e9 millimeters


@dataclass(frozen=True)
class Shot:
    """One image of a model."""

    lens: Lens
    world_from_cam: np.ndarray  # (4, 4) float64
    mask: Path | None = None  # that the model names
    time: float | None = None  # seconds from the first image on, where the model says it


@dataclass(frozen=True)
class Model:
    """Shots by the image name that the model's file gives, a path with forward slashes."""

    kind: str  # for messages: "COLMAP model", ...
    shots: Mapping[str, Shot]

    def lookup(self, images: list[Path]) -> list[Shot | None]:
        """The shot of each image, of the name that is `matched` to it."""
        return [None if name is None else self.shots[name] for name in matched(self.shots, images)]

    @property
    def common_lens(self) -> Lens | None:
        """The lens of all shots if they share one: it then holds for images without a pose too."""
        lenses = {shot.lens for shot in self.shots.values()}
        return lenses.pop() if len(lenses) == 1 else None


def matched(names: Iterable[str], images: list[Path]) -> list[str | None]:
    """Which of a model's names is each image's: by the longest end of its path that is a name, else by its bare name.

    Names of a model start at another folder than ours, and some leave the suffix out. A name is of one image: of
    several that it would suit, the one that it suits best has it, and of equals none.
    """
    known = _Names(names)
    found = [known.of(image.absolute()) for image in images]
    counts = Counter(found)
    best = dict(sorted(match for match in found if match is not None))
    alone = [match is not None and counts[match] == 1 and best[match[0]] == match[1] for match in found]
    return [match[0] if match is not None and has else None for match, has in zip(found, alone)]


_Fit = tuple[int, bool]  # parts of the path that are the whole name, 0 for a bare one; whether its suffix is the same


class _Names:
    """The names of a model, by what an image may be found under."""

    def __init__(self, names: Iterable[str]) -> None:
        names = list(names)
        counts = Counter(_bare(name) for name in names)
        self._bare = {_bare(name): name for name in names if counts[_bare(name)] == 1}
        self._whole = {_without_suffix(name): name for name in names} | {name: name for name in names}
        self._folders = {PurePosixPath(name).parent.name for name in names}

    def of(self, image: Path) -> tuple[str, _Fit] | None:
        """The name of an image, and how well it fits."""
        parts = image.parts
        for start in range(len(parts)):
            end = "/".join(parts[start:])
            for key in (end, _without_suffix(end)):
                if key in self._whole:
                    return self._whole[key], (len(parts) - start, key == end)
        name = self._bare.get(_bare(image.name))
        if name is None or self._is_elsewhere(name, image):
            return None
        return name, (0, name.endswith(image.suffix))

    def _is_elsewhere(self, name: str, image: Path) -> bool:
        """Whether a name is of a folder beside the image's: that is there, or the model knows the image's own too."""
        theirs, ours = PurePosixPath(name).parent.name, image.parent.name
        if theirs in ("", "..", ours):
            return False
        return ours in self._folders or (not _ANY.fullmatch(theirs) and (image.parent.parent / theirs).is_dir())


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """A 4x4 pose as written in a file, its rotation made exactly orthonormal. Raises ValueError if it is no pose."""
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
        raise ValueError(f"{where}: a pose must be 4x4 finite numbers")
    if np.any(np.abs(matrix[:3, 3]) > _FARTHEST):
        raise ValueError(f"{where}: a position farther than {_FARTHEST:g} from the origin, {matrix[:3, 3]}")
    u, singular, vt = np.linalg.svd(matrix[:3, :3])
    if np.any(np.abs(singular - 1.0) > 1e-2) or np.linalg.det(u @ vt) < 0:
        raise ValueError(f"{where}: its upper left 3x3 is no rotation (singular values {np.round(singular, 4)})")
    pose = np.eye(4)
    pose[:3, :3] = u @ vt
    pose[:3, 3] = matrix[:3, 3]
    return pose


def is_rigid(matrix: np.ndarray) -> bool:
    """Whether `rigid` takes it."""
    try:
        rigid(matrix, "")
    except ValueError:
        return False
    return True


def read_pose(path: Path) -> np.ndarray | None:
    """(4, 4) float64, None where the file is missing or no pose: lost frames are marked by NaN or infinity."""
    try:
        pose = read_numbers(path)
    except (OSError, BadFileError):
        return None
    return pose.reshape(4, 4) if pose.shape == (16,) and is_rigid(pose.reshape(4, 4)) else None


def _without_suffix(name: str) -> str:
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.suffix.lower().lstrip(".").isalpha() else str(path)


def _bare(name: str) -> str:
    return PurePosixPath(_without_suffix(name)).name
