"""Any video file that OpenCV opens."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from mvsgs_core.bad_file import BadFileError, brief, reading
from mvsgs_core.datasets import Item, dataset
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.files import Layout
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import FileReader
from mvsgs_core.printable import not_utf8

LAYOUT = Layout(
    "A video",
    "one file that OpenCV's FFmpeg opens: mp4, mov, mkv, avi, webm, ...",
    "your own camera or phone; walk slowly, move sideways rather than turn on the spot, lock exposure and focus",
)
# FFmpeg writes to the terminal what our errors and counts say in words; OpenCV reads this when it first opens a video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET
SUFFIXES = (  # by which a file is taken for a video where its format was not said
    ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mts", ".m2ts", ".ts", ".3gp", ".wmv", ".flv",
    ".ogv", ".mjpg", ".mjpeg", ".y4m", ".h264", ".hevc", ".insv", ".lrv",
)  # fmt: skip
_DEFAULT_RATE = 30.0
_MAX_COUNT = 2**40  # frames: more is no count
# A container's frame count is an estimate: of mkv its duration times a rate, of mp4 with the frames that are not shown.
# A gap is worth a word where it is more than both of these, in frames and in time.
_GAP_FRAMES, _GAP_SHARE = 2, 0.01


_WIDE_RANGES = {16: "PQ", 18: "HLG"}  # transfer functions of HDR video, ITU-T H.273


@dataclass(frozen=True)
class _Picture:
    seconds: float
    rgb: np.ndarray  # (H, W, 3) uint8, as in the file
    sharpness: float


@dataset
@dataclass(kw_only=True, eq=False)
class Video(FileReader):
    """Frames of a video file, undistorted, with the container's timestamps.

    intrinsics: [fx, fy, cx, cy] in pixels of the video's frames, or "auto": 65 degrees across the longer side, for the
    tracker to estimate, with pixels that are as wide as the container says. A video says nothing of its camera, so
    null is refused.
    Frames of another shape than the first are left out and counted, those of another size scaled to it. Video turned by
    its metadata is upright, and HDR is brought to the range of a photograph, what is brighter than white clipped (both
    by FFmpeg in OpenCV). Video that its metadata mirrors is so too, as players show it, with a warning.
    Raises FileNotFoundError and ValueError, which say what was expected, BadFileError for a file that has no frame.
    """

    # of each `stride` frames the sharpest, not the first: for long hand-held videos; all frames are decoded for it
    sharpest: bool = False

    @staticmethod
    def recognizes(path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in SUFFIXES

    def __post_init__(self) -> None:
        super().__post_init__()
        self._path = LAYOUT.file(LAYOUT.present(self.path))
        if self.intrinsics is None:
            raise ValueError(
                "a video does not say what camera took it: set dataset.intrinsics=[fx,fy,cx,cy] in pixels of its "
                "frames, or dataset.intrinsics=auto to have the focal length estimated"
            )
        capture = self._open()
        with reading(self._path, "cannot be decoded"):
            read, frame = capture.read()
        count, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        stretch, mirrors = _stretch(capture), _is_mirrored(self._path)
        self._flip = (1 if _is_on_its_side(capture) else 0) if mirrors else None  # as cv2.flip has it
        capture.release()
        if not read:
            raise BadFileError(f"{self._path} opens but has no frame: it is damaged, or no video")
        height, width = self._native = frame.shape[0], frame.shape[1]
        shown = max(1, round(stretch[0] * height)), max(1, round(stretch[1] * width))
        square = same_shape(shown, self._native)
        of = shown if self.intrinsics == "auto" and not square else self._native
        lens, notes = lens_from_option(self.intrinsics, self.distortion, of)
        self._lens = lens.at(self._native)
        if not square:
            notes.append(
                f"{self._path.name} has pixels that are not square: its frames of {width}x{height} are shown as "
                f"{shown[1]}x{shown[0]}, so that fy is {stretch[1] / stretch[0]:.4g} times fx"
            )
        self._open_mask(self._native)
        self._count = int(count) if 0 < count < _MAX_COUNT else 0
        self._rate = rate if math.isfinite(rate) and 0 < rate < 1000 else _DEFAULT_RATE
        self.warnings += notes + self._framing.notice(self._native) + _range_notice(self._path)
        if mirrors:
            self.warnings.append(
                f"{self._path.name} is mirrored by its metadata, and mapped as players show it: where writing in it is "
                "shown the wrong way round, so is the map; ffmpeg -i FILE -vf hflip out.mp4 mirrors it back"
            )
        if self._count and self.start >= self._count:
            raise ValueError(f"no frame left: {self._path.name} has {self._count}, wanted from {self.start}")
        if self._rate != rate:
            self.warnings.append(f"{self._path.name} gives no frame rate: {_DEFAULT_RATE:.0f} per second assumed")
        self._opening_warnings = len(self.warnings)

    @property
    def lens(self) -> Lens:
        """Of the image as it is in the file."""
        return self._lens

    def __len__(self) -> int:
        """Frames selected, as far as the container knows its own length; 0 where it does not and `stop` is null."""
        end = self._count or self.wanted.stop or self.wanted.start
        return len(range(end)[self.wanted])

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)  # those of an earlier pass
        capture = self._open()
        number = index = 0
        group: _Picture | None = None  # the best since the last one that was wanted
        first, last = math.inf, -math.inf  # seconds
        try:
            while self.wanted.stop is None or number < self.wanted.stop:
                if not capture.grab():
                    self._judge_end(number, last - first)
                    break
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
                if not math.isfinite(seconds) or seconds <= last:
                    seconds = last + 1.0 / self._rate if math.isfinite(last) else number / self._rate
                first, last = min(first, seconds), seconds
                offset = number - self.wanted.start
                if offset >= 0 and offset % self.wanted.step == 0 and group:
                    yield self._item(index, group)
                    index, group = index + 1, None
                if offset >= 0 and (self.sharpest or offset % self.wanted.step == 0):
                    group = self._better(group, self._picture(number, seconds, capture))
                number += 1
            if group:
                yield self._item(index, group)
                index += 1
        finally:
            capture.release()
        self._end_places()
        if index == 0:
            raise BadFileError(f"no frame of {self._path} could be read: " + "; ".join(self.warnings))

    def _better(self, best: _Picture | None, other: _Picture | None) -> _Picture | None:
        if best is None or other is None:
            return best or other
        return other if other.sharpness > best.sharpness else best

    def _picture(self, number: int, seconds: float, capture: cv2.VideoCapture) -> _Picture | None:
        """The frame that was grabbed; None, and counted, where it cannot be used."""
        try:
            decoded, frame = capture.retrieve()
            if not decoded:
                raise ValueError("the decoder gave no picture")
            if self._flip is not None:
                frame = cv2.flip(frame, self._flip)
            native = frame.shape[0], frame.shape[1]
            if not same_shape(native, self._native):
                raise ValueError(f"{native[1]}x{native[0]} after {self._native[1]}x{self._native[0]}")
            sharpness = _sharpness(frame) if self.sharpest else 0.0
            return _Picture(seconds, np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)), sharpness)
        except (ValueError, cv2.error) as error:
            what = f"frames of {self._path.name} left out because they could not be decoded"
            self._notices.tally(what, f"frame {number}: {brief(error)}")
            return None

    def _item(self, index: int, picture: _Picture) -> Item:
        lens = self._lens.at((picture.rgb.shape[0], picture.rgb.shape[1]))
        image, intrinsics = self._framing.image(picture.rgb, lens, self._framing.size_of(self._native))
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, lens, image.shape[:2])
        place, guessed = self._place(picture.seconds, began=partial(_began, self._path)), self._lens.guessed
        original = np.array(self._lens.intrinsics, np.float64)
        return Item(
            index, picture.seconds, image, intrinsics, intrinsics_guessed=guessed, place=place, mask=mask,
            original=original,
        )  # fmt: skip

    def _judge_end(self, frames: int, seconds: float) -> None:
        """Warns where the file ends after `frames`, the last `seconds` after the first, and promised more than that."""
        missing = self._count - frames
        missing_time = (self._count - 1) / self._rate - seconds
        allowed = max(_GAP_FRAMES, _GAP_SHARE * self._count)
        if missing > allowed and missing_time * self._rate > allowed:
            self.warnings.append(
                f"{self._path.name} ends after {frames} of {self._count} frames: it is cut off or damaged"
            )

    def _open(self) -> cv2.VideoCapture:
        if problem := not_utf8([str(self._path)]):  # OpenCV crashes
            raise BadFileError(problem)
        loud = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the error below says it in words
        try:
            with reading(self._path, "cannot be opened by OpenCV"):
                capture = cv2.VideoCapture(str(self._path))
        finally:
            cv2.utils.logging.setLogLevel(loud)
        if not capture.isOpened():
            raise BadFileError(
                f"OpenCV cannot open {self._path}: no video, cut off before its index was written (record it again, or "
                "repair it with untrunc), or a codec that OpenCV was built without (ffmpeg -i FILE out.mp4 converts it)"
            )
        return capture


def _stretch(capture: cv2.VideoCapture) -> tuple[float, float]:
    """What height and width of an upright frame are multiplied by when it is shown, as the container says."""
    wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    aspect = wide / high if wide > 0 and high > 0 else 1.0  # 0: not said
    return (aspect, 1.0) if _is_on_its_side(capture) else (1.0, aspect)


def _is_on_its_side(capture: cv2.VideoCapture) -> bool:
    """Whether its metadata turns it by a quarter."""
    return bool(capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == 90)


def _is_mirrored(path: Path) -> bool:
    """Whether its metadata mirrors it. OpenCV turns such a frame so that its rows run as they are shown, and leaves
    its columns the wrong way round. OpenCV judges a video that does not open."""
    try:
        with av.open(str(path)) as container:
            frame = next(iter(container.decode(container.streams.video[0])))
            of_frame: Any = frame.side_data  # PyAV's own types know of motion vectors alone
            shown = np.frombuffer(bytes(of_frame["DISPLAYMATRIX"]), np.int32).reshape(3, 3)
    except (av.FFmpegError, IndexError, KeyError, OSError, StopIteration, ValueError):
        return False
    return bool(np.linalg.det(shown[:2, :2]) < 0.0)


def _sharpness(frame: np.ndarray) -> float:
    """Mean square of the Laplacian, at half the size where it is the motion's blur and not the noise that counts."""
    gray = cv2.cvtColor(cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
    return float(np.mean(np.square(cv2.Laplacian(gray, cv2.CV_32F))))


def _began(path: Path) -> str | None:
    """When the file says that it was recorded, ISO 8601; None where it does not."""
    try:
        with av.open(str(path)) as container:
            return container.metadata.get("creation_time")
    except (av.FFmpegError, OSError, ValueError):
        return None


def _range_notice(path: Path) -> list[str]:
    """What to say of a video whose range is wider than a photograph's. OpenCV judges one that does not open."""
    try:
        with av.open(str(path)) as container:
            transfer = int(container.streams.video[0].codec_context.color_trc)
    except (av.FFmpegError, IndexError, OSError, ValueError):
        return []
    if transfer not in _WIDE_RANGES:
        return []
    return [f"{path.name} is HDR video ({_WIDE_RANGES[transfer]}), mapped to a photograph's range, highlights clipped"]
