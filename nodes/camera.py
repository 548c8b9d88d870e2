"""Source: a live camera. What nobody takes in time is dropped here, and counted; never the newest frame."""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from msgs import Frame
from mvsgs_core.datasets.calibration import check_lens_option, lens_from_option
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.export.source_camera import LENS, lens_values
from mvsgs_core.passwords import without_passwords
from nodes.live import POLL, LiveSource, camera_mask
from nodes.stream_presence import Presence, pauses

ANSWER = 5.0  # s for a network camera to answer, before it is tried again
DEVICES = "/dev/"
MANY = 2**40  # frames: no file has as many; OpenCV counts them so, or below zero, where a stream has no end


class CameraError(OSError):
    """A camera that cannot be opened; the message says what to check."""


class Camera(LiveSource):
    """A device or a URL. Raises CameraError if it cannot be opened, TimeoutError if it never gives a picture."""

    stamped: ClassVar[bool] = False

    @dataclass
    class Config(LiveSource.Config):
        path: str = "0"  # device number, or what OpenCV opens: rtsp://host/stream, http://host/video.mjpg, /dev/video2
        resolution: list[int] | None = None  # [height, width] asked of the device; null: its own choice
        fps: float | None = None  # asked of the device, frames per second; null: its own choice
        intrinsics: list[float] | str = "auto"  # [fx, fy, cx, cy] in pixels of the camera's picture; auto: a guess
        distortion: list[float] = field(default_factory=list)  # [k1, k2, p1, p2] or with k3, as in OpenCV
        crop: int | None = None  # pixels cut off after undistortion; null: zoom to hide the empty border

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._framing = Framing(self.config.size, self.config.crop)
        self._lens: Lens | None = None

    @classmethod
    def check(cls, config: Config) -> None:
        check_lens_option(config.intrinsics, config.distortion, config.resolution)
        camera_mask(config.mask)
        number = device_number(config.path)
        device = Path(f"/dev/video{number}" if config.path.isdecimal() else config.path)
        _refuse_file(config.path)
        local = number is not None or config.path.startswith(DEVICES)
        if local and sys.platform == "linux" and not device.exists():
            there = sorted(str(path) for path in Path(DEVICES).glob("video*"))
            found = f"there is {', '.join(there)}" if there else "no camera is connected"
            raise CameraError(f"camera {config.path}: {device} does not exist; {found}")

    def _open(self) -> None:
        self._feed = _Feed(self.config, self._presence)

    def _close(self) -> None:
        self._feed.close()

    @property
    def _sender(self) -> str:
        return _called(self.config)

    @property
    def _silence(self) -> str:
        return f"{self._sender} gave no usable picture"

    def _hint(self) -> str:
        return "it was opened, but gives none"

    def _next(self, seconds: float) -> Frame | None:
        shot = self._feed.newest(seconds)
        self.stats.counts["dropped"] = self._feed.dropped
        if shot is None:
            return None
        picture, timestamp, stamp = shot
        lens = self._lens_of(picture)
        return Frame(0, timestamp, picture, np.array(lens.intrinsics), lens.guessed, stamp=stamp)

    def _lens_of(self, picture: np.ndarray) -> Lens:
        """Of the stream: its first picture's."""
        if self._lens is None:
            native = picture.shape[0], picture.shape[1]
            self._lens, notes = lens_from_option(self.config.intrinsics, self.config.distortion, native)
            self.stats.values[LENS] = lens_values(self._lens)
            for note in notes + self._framing.notice(native):
                self.stats.warn(note)
        return self._lens

    def _framed(self, frame: Frame) -> Frame:
        assert self._lens is not None
        rgb = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2RGB))
        size = self._framing.size_of(self._lens.size)
        image, intrinsics = self._framing.image(rgb, self._lens, size)
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, self._lens, size)
        return replace(frame, image=image, intrinsics=intrinsics, mask=mask)


class _Feed:
    """A thread that reads the camera as fast as it delivers, and keeps the newest picture only.

    A camera that was lost is opened again, at growing pauses, until it gives pictures.
    """

    def __init__(self, config: Camera.Config, presence: Presence) -> None:
        self.dropped = 0
        self._presence = presence
        self._config = config
        self._closing = threading.Event()
        self._fresh = threading.Condition()
        self._newest: tuple[np.ndarray, float, int] | None = None
        self._began = time.time() - time.monotonic()  # times go on evenly even if the clock is set
        self._capture: cv2.VideoCapture | None = _open(config)
        self._thread = threading.Thread(target=self._read, name="camera", daemon=True)
        self._thread.start()

    def newest(self, timeout_s: float) -> tuple[np.ndarray, float, int] | None:
        """The newest picture that was not taken yet, its time and stamp; None when none comes in time."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._newest is not None, timeout_s)
            shot, self._newest = self._newest, None
            return shot

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=2 * POLL)  # a read that hangs must not hold the run back: the thread is a daemon

    def _read(self) -> None:
        attempts, size = pauses(self._config.timeout), self._config.resolution
        while not self._closing.is_set():
            read, picture = (False, None) if self._capture is None else self._capture.read()
            if not read or picture is None:
                if not self._closing.is_set():
                    self._presence.lost("it gives no picture" if self._capture else "it cannot be opened")
                    self._reopen(next(attempts), size)
                continue
            attempts, size = pauses(self._config.timeout), [picture.shape[0], picture.shape[1]]
            self._presence.came()
            with self._fresh:
                self.dropped += self._newest is not None
                self._newest = picture, self._began + time.monotonic(), time.time_ns()
                self._fresh.notify()
        if self._capture is not None:
            self._capture.release()

    def _reopen(self, pause: float, size: list[int] | None) -> None:
        """An attempt after a pause; pictures of the size that they had are asked for."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None
        if not self._closing.wait(pause):
            with suppress(CameraError):
                self._capture = _open(replace(self._config, resolution=size))


def _called(config: Camera.Config) -> str:
    """The camera in messages, which reports and logs show."""
    return f"camera {without_passwords(config.path)}"


def device_number(path: str) -> int | None:
    """Of a camera of this machine: 2 for 2, /dev/video2 and what links to it now, as in /dev/v4l/by-id. None for an
    address."""
    if path.startswith(DEVICES):
        path = os.path.realpath(path)
    found = re.fullmatch(r"(?:/dev/video)?([0-9]+)", path)
    return None if found is None else int(found[1])


def _refuse_file(path: str) -> None:
    """Which would begin anew whenever it ended, as a camera that was lost."""
    file = re.sub("^file:(//)?", "", path, flags=re.IGNORECASE)  # an address that OpenCV opens, too
    if file != path or Path(path).is_file():
        raise CameraError(f"{path} is a file and no camera: use dataset=video dataset.path={file}")


def _open(config: Camera.Config) -> cv2.VideoCapture:
    _refuse_file(config.path)
    number = device_number(config.path)
    if number is not None:
        capture = cv2.VideoCapture(number)  # by its name with limits of time, as below, OpenCV does not open it
        hint = "is it connected, free of other programs, and may you read it (ls -l /dev/video*)?"
    elif config.path.startswith(DEVICES) and not Path(config.path).exists():
        raise CameraError(f"{_called(config)} cannot be opened: it does not exist; is it connected?")
    else:
        milliseconds = int(1000 * min(config.timeout, ANSWER))
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
        loud = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it writes the password, too
        try:
            capture = cv2.VideoCapture(config.path, cv2.CAP_ANY, limits)
        finally:
            cv2.utils.logging.setLogLevel(loud)
        hint = "is the address right (ffplay shows the same one), and does the network let it through?"
    if not capture.isOpened():
        capture.release()
        raise CameraError(f"{_called(config)} cannot be opened: {hint}")
    if number is None and 0 < capture.get(cv2.CAP_PROP_FRAME_COUNT) < MANY:
        capture.release()
        raise CameraError(
            f"{_called(config)} is a video file, which ends, and no camera: give the file, downloaded if need be, "
            "as in `mvsgs walk.mp4`"
        )
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # drivers that queue pictures would deliver old ones
    if config.resolution is not None:
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.resolution[0])
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.resolution[1])
    if config.fps is not None:
        capture.set(cv2.CAP_PROP_FPS, config.fps)
    return capture
