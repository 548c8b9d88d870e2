"""The frames of a program, checked one by one: what cannot belong to the stream is refused where it comes from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real

import numpy as np

from msgs import Frame, GroundTruth
from mvsgs_core.datasets.calibration import FISHEYE, check_lens_option, size_doubt
from mvsgs_core.datasets.framing import Framing, Size
from mvsgs_core.datasets.lens import Lens, guess_lens
from mvsgs_core.geometry import is_rigid
from mvsgs_core.stream_times import LATEST
from nodes.stream_frames import MAX_SIDE, MIN_SIDE

SAME = 1e-3  # intrinsics that differ by less are those of one camera

Numbers = Sequence[float] | np.ndarray


class Frames:
    """One camera's frames, which are numbered as they come, and brought to the size that is mapped.

    `lens`: the camera, once the first frame has come. `notices`: what to tell about it.
    """

    def __init__(
        self, intrinsics: Numbers | None, distortion: Numbers, fisheye: bool, size: Size, posed: bool
    ) -> None:  # fmt: skip
        """Raises ValueError for a size or numbers that are none."""
        self.lens: Lens | None = None
        self.notices: list[str] = []
        self._given = None if intrinsics is None else _intrinsics(intrinsics)
        self._distortion, self._fisheye = tuple(float(k) for k in distortion), fisheye
        if self._distortion and self._given is None:
            raise ValueError("distortion without intrinsics: it is known together with them")
        if self._given is not None:
            check_lens_option(self._given.tolist(), [*([FISHEYE] if fisheye else []), *self._distortion])
        self._framing, self._posed = Framing(size), posed
        self._count, self._last = 0, -math.inf

    def accept(
        self, image: np.ndarray, timestamp: float, intrinsics: Numbers | None, pose: np.ndarray | None,
        mask: np.ndarray | None = None,
    ) -> tuple[Frame, GroundTruth]:  # fmt: skip
        """The messages of the next frame. Raises TypeError, ValueError for one that is none; nothing has changed then.

        image: (H, W, 3) uint8, of which a copy is made. mask: (H, W) bool or uint8, 0 where a pixel is to be ignored.
        """
        size = _size(image)
        lens = self._lens(size, intrinsics)
        seconds = self._time(timestamp)
        world_from_cam = self._pose(pose)
        seen = _mask(mask, size)
        if self.lens is None:
            self.lens, self.notices = lens, size_doubt(lens, "intrinsics=") + self._framing.notice(size)
        shown, focal = self._framing.image(np.array(image, order="C"), lens, self._framing.size_of(size))
        index = self._count
        self._count, self._last = index + 1, seconds
        if seen is not None:
            seen = self._framing.mask(seen, lens, self._framing.size_of(size))
        original = np.array(lens.intrinsics, np.float64)
        frame = Frame(index, seconds, shown, focal, lens.guessed, mask=seen, original_intrinsics=original)
        return frame, GroundTruth(index, seconds, shown, focal, world_from_cam, None, mask=seen)

    def _lens(self, size: tuple[int, int], intrinsics: Numbers | None) -> Lens:
        given = self._given if intrinsics is None else _intrinsics(intrinsics)
        if self.lens is None:
            if given is None:
                return guess_lens(size)
            fx, fy, cx, cy = given.tolist()
            return Lens((fx, fy, cx, cy), size, self._distortion, self._fisheye)
        if size != self.lens.size:
            raise ValueError(
                f"a frame of {size[1]}x{size[0]} after frames of {self.lens.size[1]}x{self.lens.size[0]}: one camera's "
                "frames have one size; another camera is another Mapping"
            )
        if given is not None and (self.lens.guessed or not np.allclose(given, self.lens.intrinsics, rtol=SAME)):
            known = "none" if self.lens.guessed else list(self.lens.intrinsics)
            raise ValueError(f"intrinsics {given.tolist()}: the first frame had {known}; a camera keeps its own")
        return self.lens

    def _time(self, timestamp: float) -> float:
        if isinstance(timestamp, bool) or not isinstance(timestamp, Real):
            raise TypeError(f"timestamp must be a number of seconds, not {type(timestamp).__name__}")
        seconds = float(timestamp)
        if not abs(seconds) <= LATEST:
            raise ValueError(f"timestamp {seconds} is no time in seconds")
        if seconds <= self._last:
            raise ValueError(f"timestamp {seconds} is not after the last frame's, {self._last}: time goes forward")
        return seconds

    def _pose(self, pose: np.ndarray | None) -> np.ndarray | None:
        if pose is None:
            if self._posed:
                raise ValueError("a frame without a pose: with poses=True each frame has its own")
            return None
        if not self._posed:
            raise ValueError("a frame with a pose, which the tracker finds by itself: Mapping(poses=True) takes yours")
        found = np.array(pose, dtype=np.float64)
        if found.shape != (4, 4):
            raise ValueError(f"a pose is a (4, 4) matrix world_from_cam, got an array of shape {found.shape}")
        if not np.isfinite(found).all():
            raise ValueError("a pose with a value that is not finite: leave out frames that have none")
        if not is_rigid(found):
            raise ValueError("a pose that is no rotation and position: its last row is 0 0 0 1, its axes have length 1")
        return found


def _size(image: np.ndarray) -> tuple[int, int]:
    if not isinstance(image, np.ndarray):
        raise TypeError(f"an image is a numpy array of (height, width, 3) uint8, not {type(image).__name__}")
    if image.ndim != 3 or image.shape[2] != 3:
        hint = "; a gray image: np.repeat(image[..., None], 3, axis=2)" if image.ndim == 2 else ""
        raise ValueError(f"an image is (height, width, 3) RGB, got an array of shape {image.shape}{hint}")
    if image.dtype != np.uint8:
        raise ValueError(f"an image is uint8, 0 to 255, got {image.dtype}; of 0 to 1: (255 * image).astype(np.uint8)")
    height, width = image.shape[:2]
    if not MIN_SIDE <= min(height, width) <= max(height, width) <= MAX_SIDE:
        raise ValueError(f"an image of {width}x{height}: its sides must be {MIN_SIDE} to {MAX_SIDE} pixels")
    return height, width


def _mask(mask: np.ndarray | None, size: tuple[int, int]) -> np.ndarray | None:
    """(H, W) bool. Raises TypeError, ValueError for what is no mask of an image of that size."""
    if mask is None:
        return None
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.bool_, np.uint8):
        what = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise TypeError(f"a mask is a numpy array of (height, width) bool or uint8, 0 is ignored; not {what}")
    if mask.shape != size:
        raise ValueError(f"a mask has its image's height and width, {size}, got an array of shape {mask.shape}")
    if not mask.any():
        raise ValueError("a mask that ignores every pixel: leave the frame out")
    return mask > 0


def _intrinsics(given: Numbers) -> np.ndarray:
    found = np.asarray(given, dtype=np.float64)
    if found.shape == (3, 3):
        raise ValueError("intrinsics are (fx, fy, cx, cy): of a matrix K, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]")
    if found.shape != (4,) or not np.isfinite(found).all():
        raise ValueError(f"intrinsics are four finite numbers (fx, fy, cx, cy), got {given}")
    return found


__all__ = ["Frames", "Numbers"]
