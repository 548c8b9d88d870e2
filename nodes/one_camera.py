"""Frames of a camera whose focus or stabilization moves, as phones record it, as one camera would have taken them.

Bundle adjustment, stereo and the shutter's motion are those of one camera. Where a data set has intrinsics of each
frame, a frame is resampled to those of the first: for a pinhole camera that is a zoom and a shift, and exact.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msgs import Frame
from mvsgs_core.camera import resampled, same_intrinsics, scale_intrinsics
from mvsgs_core.stats import Stats

FAR = 0.1  # relative difference of focal lengths that is no autofocus


class OneCamera:
    """That of the first frame; its intrinsics follow an image's size."""

    def __init__(self) -> None:
        self._intrinsics: np.ndarray | None = None  # (4,) of the first frame
        self._size = (0, 0)  # (height, width) of that

    def frame(self, frame: Frame, stats: Stats) -> Frame:
        """Itself where its intrinsics are the first frame's; else resampled, with a mask of what it does not show."""
        size = frame.image.shape[0], frame.image.shape[1]
        if self._intrinsics is None:
            self._intrinsics, self._size = frame.intrinsics.copy(), size
        ours = scale_intrinsics(self._intrinsics, self._size, size)
        if frame.intrinsics_guessed or same_intrinsics(frame.intrinsics, ours):
            return frame
        stats.count("frames resampled to the intrinsics of the first")
        if not np.allclose(frame.intrinsics[:2], ours[:2], rtol=FAR):
            stats.warn(
                "the focal length changes while the stream runs: frames are taken as the first one's camera sees them; "
                "what lies beyond that view is left out, and those of a longer focal length show a part of it"
            )
        image = resampled(frame.image, frame.intrinsics, ours)
        seen = np.ones(size, np.uint8) if frame.mask is None else frame.mask.astype(np.uint8)
        mask = resampled(seen, frame.intrinsics, ours, nearest=True).astype(bool)
        return replace(frame, image=image, intrinsics=ours, mask=None if mask.all() else mask)
