"""Any video file that OpenCV opens."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.files import Layout
from mvsgs_core.datasets.framing import Framing, Size
from mvsgs_core.datasets.sequence import selection

LAYOUT = Layout(
    "A video",
    "one file that OpenCV's FFmpeg opens: mp4, mov, mkv, avi, webm, ...",
    "your own camera or phone; walk slowly, move sideways rather than turn on the spot, lock exposure and focus",
)
_DEFAULT_RATE = 30.0
_SHORT = 0.98  # less of the promised frames than this: the file is cut off (containers overstate by a frame or two)


class Video:
    """Frames of a video file, undistorted, with the container's timestamps.

    intrinsics: [fx, fy, cx, cy] in pixels of the video's frames, or "auto": 65 degrees across the longer side, for the
    tracker to estimate. A video says nothing of its camera, so null is refused. size, crop: see `Framing`.
    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Size = None,
        intrinsics: Sequence[float] | str | None = None,
        distortion: Sequence[float] = (),
        crop: int | None = None,
    ) -> None:
        if path is None or not str(path):
            raise LAYOUT.missing("no path was given (set dataset.path)")
        self._path = LAYOUT.file(Path(path).expanduser())
        if intrinsics is None:
            raise ValueError(
                "a video does not say what camera took it: set dataset.intrinsics=[fx,fy,cx,cy] in pixels of its "
                "frames, or dataset.intrinsics=auto to have the focal length estimated"
            )
        self._wanted = selection(start, stop, stride)
        self._framing = Framing(size, crop)
        self.warnings: list[str] = []
        capture = self._open()
        read, frame = capture.read()
        count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        if not read:
            raise ValueError(f"{self._path} opens but has no frame: it is damaged, or no video")
        self._lens, notes = lens_from_option(intrinsics, distortion, (frame.shape[0], frame.shape[1]))
        self._count = int(count) if math.isfinite(count) and count > 0 else 0
        self._rate = rate if math.isfinite(rate) and 0 < rate < 1000 else _DEFAULT_RATE
        self.warnings += notes
        if self._count and start >= self._count:
            raise ValueError(f"no frame left: {self._path.name} has {self._count}, wanted from {start}")
        if self._rate != rate:
            self.warnings.append(f"{self._path.name} gives no frame rate: {_DEFAULT_RATE:.0f} per second assumed")
        self._opening_warnings = len(self.warnings)

    def __len__(self) -> int:
        """Frames selected, as far as the container knows its own length; 0 where it does not and `stop` is null."""
        end = self._count or self._wanted.stop or self._wanted.start
        return len(range(end)[self._wanted])

    def __iter__(self) -> Iterator[Item]:
        del self.warnings[self._opening_warnings :]  # those of an earlier pass
        capture = self._open()
        number = index = undecoded = 0
        last = -math.inf
        try:
            while (self._wanted.stop is None or number < self._wanted.stop) and capture.grab():
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                if not math.isfinite(seconds) or seconds <= last:
                    seconds = last + 1.0 / self._rate if math.isfinite(last) else number / self._rate
                last = seconds
                offset = number - self._wanted.start
                if offset >= 0 and offset % self._wanted.step == 0:
                    decoded, frame = capture.retrieve()
                    if decoded:
                        yield self._item(index, seconds, frame)
                        index += 1
                    else:
                        undecoded += 1
                number += 1
        finally:
            capture.release()
        promised = min(self._count, self._wanted.stop or self._count)
        if number < _SHORT * promised:
            self.warnings.append(
                f"{self._path.name} ends after {number} of {promised} frames: it is cut off or damaged"
            )

        if undecoded:
            self.warnings.append(f"frames of {self._path.name} left out because they could not be decoded: {undecoded}")

    def _item(self, index: int, seconds: float, frame: np.ndarray) -> Item:
        native = frame.shape[0], frame.shape[1]
        rgb = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
        image, intrinsics = self._framing.image(rgb, self._lens.at(native), self._framing.size_of(native))
        return Item(index, seconds, image, intrinsics, intrinsics_guessed=self._lens.guessed)

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise ValueError(
                f"OpenCV cannot open {self._path}: no video, damaged, or a codec that it was built without"
            )
        return capture
