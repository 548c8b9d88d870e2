"""Keyframes whose splats are larger than their images ask for, as a live stream left no time for more, with the depth
that the rest of their splats needs: they get it when there is time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from mvsgs_core.mapping.keyframes import HALF_MAX, RGBDKeyframe
from mvsgs_core.stats import Stats

MAX_BYTES = 256_000_000  # of what is kept: of some 300 keyframes at the size of a depth map
LATER = "keyframes that got the rest of their splats later"


@dataclass(frozen=True)
class Kept:
    """A keyframe's depth in half precision, finer than matching is."""

    keyframe: RGBDKeyframe  # its arrays float16, depths in units of `unit`
    unit: float
    none: bool  # the map has no splats of it at all
    image: np.ndarray | None  # (H, W, 3) uint8, free of the rolling shutter; None: it is the one that is trained on

    @property
    def bytes(self) -> int:
        k = self.keyframe
        return sum(a.nbytes for a in (k.depth, k.unfiltered, k.confidence, k.normals, self.image) if a is not None)


class CoarseKeyframes:
    """Oldest first; of too many the oldest stay as they are, which is counted."""

    def __init__(self, log: Stats) -> None:
        self._kept: OrderedDict[int, Kept] = OrderedDict()  # by index
        self._log = log

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def kept(self) -> list[Kept]:
        """Never changed: to be shared with a copy of the map."""
        return list(self._kept.values())

    def take(self, kept: Iterable[Kept]) -> None:
        """These wait as they did in another map."""
        self._kept |= {k.keyframe.index: k for k in kept}

    @property
    def bytes(self) -> int:
        return sum(kept.bytes for kept in self._kept.values())

    def wait(self, keyframe: RGBDKeyframe, none: bool = False) -> None:
        """A keyframe of which the map has coarse splats now, or none; its depths may be anything."""
        known = _known(keyframe.depth)
        if keyframe.unfiltered is not None and not len(known):
            known = _known(keyframe.unfiltered)
        if not len(known):
            return
        unit = float(known.mean())
        small = replace(
            keyframe, image=np.zeros((0, 0, 3), dtype=np.uint8), photograph=None, mask=None,
            depth=_half(keyframe.depth, unit),
            unfiltered=None if keyframe.unfiltered is None else _half(keyframe.unfiltered, unit),
            confidence=None if keyframe.confidence is None else _half(keyframe.confidence),
            normals=None if keyframe.normals is None else _half(keyframe.normals),
        )  # fmt: skip
        # a copy: a view of its message would keep all of that
        image = None if keyframe.photograph is None else keyframe.image.copy()
        self._kept[keyframe.index] = Kept(small, unit, none, image)
        while self.bytes > MAX_BYTES:
            self._kept.popitem(last=False)
            self._log.skip("keyframes whose splats stay larger than their images ask for")

    def next(self) -> tuple[RGBDKeyframe, np.ndarray | None] | None:
        """The one that has waited longest, without its image, which is the other where it is not what is trained on."""
        if not self._kept:
            return None
        _, kept = self._kept.popitem(last=False)
        return _given(kept)

    def without(self) -> tuple[RGBDKeyframe, np.ndarray | None] | None:
        """The oldest without any splats, as in `next`; it has coarse ones from now on, and waits for the rest."""
        for index, kept in self._kept.items():
            if kept.none:
                self._kept[index] = replace(kept, none=False)
                return _given(kept)
        return None

    def take_over(self, other: CoarseKeyframes) -> None:
        self._kept = OrderedDict(sorted((self._kept | other._kept).items()))


def _given(kept: Kept) -> tuple[RGBDKeyframe, np.ndarray | None]:
    k = kept.keyframe
    found = replace(
        k, depth=_single(k.depth, kept.unit),
        unfiltered=None if k.unfiltered is None else _single(k.unfiltered, kept.unit),
        confidence=None if k.confidence is None else _single(k.confidence),
        normals=None if k.normals is None else _single(k.normals),
    )  # fmt: skip
    return found, kept.image


def _known(depth: np.ndarray) -> np.ndarray:
    return depth[(depth > 0) & np.isfinite(depth)]


def _half(values: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """(...) float16, 0 for what is beyond them; PyTorch's conversion takes a fifth of the time of NumPy's."""
    scaled = values * np.float32(1.0 / unit)
    scaled[~(np.abs(scaled) <= HALF_MAX)] = 0.0
    return np.asarray(torch.from_numpy(scaled).half().numpy())


def _single(values: np.ndarray, unit: float = 1.0) -> np.ndarray:
    return values.astype(np.float32) * np.float32(unit)


__all__ = ["LATER", "CoarseKeyframes", "Kept"]
