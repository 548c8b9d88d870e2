"""Which frames may become keyframes: those against which the last one has moved enough (DROID-SLAM, section 3.3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

from mvsgs_core.droid.networks import Networks


class Encoded(NamedTuple):
    features: Tensor  # (128, h, w)
    hidden: Tensor  # (128, h, w)
    context: Tensor  # (128, h, w)


class MotionFilter:
    """threshold: mean length of the flow that one update sees, in cells."""

    def __init__(self, networks: Networks, threshold: float) -> None:
        self.networks, self.threshold = networks, threshold
        self._last: Encoded | None = None

    def passes(self, image: np.ndarray) -> Encoded | None:
        """An image (8h, 8w, 3) as the networks see it, None if it is too near the last that passed; the first does."""
        features = self.networks.features([image])[0]
        if self._last is not None and self._motion(self._last, features) <= self.threshold:
            return None
        self._last = Encoded(features, *self.networks.context(image))
        return self._last

    def _motion(self, last: Encoded, features: Tensor) -> float:
        h, w = features.shape[1:]
        here = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1)[None]
        correlation = self.networks.correlation(last.features, features, "volume")
        revision = self.networks.revise([last.hidden], [last.context], [correlation], here, None, None)
        return float(np.linalg.norm(revision.delta, axis=-1).mean())


__all__ = ["Encoded", "MotionFilter"]
