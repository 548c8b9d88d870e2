"""Masks in a source's frames what is fixed to the camera, and says so."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np

from msgs import Frame
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.fixed_parts import FixedParts
from mvsgs_core.stats import Stats

AHEAD = 64  # frames of a file that are read before the first goes out, at most
AHEAD_BYTES = 128 * 2**20  # and their size
MUCH = 0.3  # of an image: bars beside an upright video take as much, but little else that a moving camera carries

F = TypeVar("F", Frame, Item)


class FixedMask:
    """Looks at the frames of one camera in their order."""

    def __init__(self, stats: Stats, wanted: bool) -> None:
        """wanted: whether to look at all."""
        self._parts = FixedParts() if wanted else None
        self._stats = stats
        self._said = False

    def masked(self, frame: F) -> F:
        """With what is known by now, this frame included."""
        self._look(frame.image)
        return self._with_mask(frame)

    def masked_ahead(self, items: Iterable[Item]) -> Iterator[Item]:
        """All of them; the first wait until enough are known."""
        waiting: deque[Item] = deque()
        for item in items:
            self._look(item.image)
            waiting.append(item)
            known = self._parts is None or self._parts.judged
            if known or len(waiting) >= AHEAD or len(waiting) * _bytes(item) > AHEAD_BYTES:
                while waiting:
                    yield self._with_mask(waiting.popleft())
        for item in waiting:
            yield self._with_mask(item)

    def _look(self, image: np.ndarray) -> None:
        if self._parts is None:
            return
        self._parts.add(image)
        if self._parts.mask is not None and not self._said:
            self._said = True
            much = ". So much is bars beside a video, or what a camera that stands sees while something moves before it"
            self._stats.warn(
                f"{100 * self._parts.share:.1f} % of the image is fixed to the camera, as bars, a logo, a car's hood "
                "are: masked (dataset.hide_fixed=false: it is taken for the scene)"
                f"{much if self._parts.share > MUCH else ''}"
            )

    def _with_mask(self, frame: F) -> F:
        fixed = None if self._parts is None else self._parts.mask
        if fixed is None or fixed.shape != frame.image.shape[:2]:
            return frame
        left = fixed if frame.mask is None else fixed & frame.mask
        return replace(frame, mask=left) if left.any() else frame


def _bytes(item: Item) -> int:
    return item.image.nbytes + (0 if item.depth is None else item.depth.nbytes)


__all__ = ["FixedMask"]
