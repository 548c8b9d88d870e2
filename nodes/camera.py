"""Source: a live camera. What nobody takes in time is dropped here, and counted; never the newest frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from msgs import Frame
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.datasets.lens import Lens
from nodes.live import LiveSource

POLL = 0.5  # s at most between two looks at whether the stream goes on
RETRY = 0.5  # s between two attempts to open a device that was lost
SILENT = 2.0  # s without a picture after which a user is warned, if the camera may be silent that long


class CameraError(RuntimeError):
    """A camera that cannot be opened or gives no picture; the message says what to check."""


class Camera(LiveSource):
    """A device or a URL. Raises CameraError if it cannot be opened or never gives a picture."""

    @dataclass
    class Config(LiveSource.Config):
        path: str = "0"  # device number, or what OpenCV opens: rtsp://host/stream, http://host/video.mjpg, /dev/video2
        resolution: list[int] | None = None  # [height, width] asked of the device; null: its own choice
        fps: float | None = None  # asked of the device, frames per second; null: its own choice
        intrinsics: list[float] | str = "auto"  # [fx, fy, cx, cy] in pixels of the camera's picture; auto: a guess
        distortion: list[float] = field(default_factory=list)  # [k1, k2, p1, p2] or with k3, as in OpenCV
        crop: int | None = None  # pixels cut off after undistortion; null: zoom to hide the empty border
        timeout: float = 10.0  # s without a picture before the camera counts as lost

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._framing = Framing(self.config.size, self.config.crop)
        self._lens: Lens | None = None

    def _open(self) -> None:
        self._feed = _Feed(self.config, self.stats.warn)

    def _close(self) -> None:
        self._feed.close()

    def _take(self, first: bool) -> Frame | None:
        shot = self._feed.newest(self.config.timeout)
        self.stats.counts["dropped"] = self._feed.dropped
        if shot is None:
            if first:
                raise CameraError(f"camera {self.config.path} gave no picture for {self.config.timeout:g} s")
            self.stats.warn(f"camera {self.config.path} was lost: no picture for {self.config.timeout:g} s")
            return None
        picture, timestamp = shot
        native = picture.shape[0], picture.shape[1]
        if self._lens is None:
            self._lens, notes = lens_from_option(self.config.intrinsics, self.config.distortion, native)
            for note in notes:
                self.stats.warn(note)
        if native != self._lens.size:
            raise CameraError(f"camera {self.config.path} changed its picture from {self._lens.size} to {native}")
        return Frame(0, timestamp, picture, np.array(self._lens.intrinsics), self._lens.guessed)

    def _framed(self, frame: Frame) -> Frame:
        assert self._lens is not None
        rgb = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2RGB))
        image, intrinsics = self._framing.image(rgb, self._lens, self._framing.size_of(self._lens.size))
        return replace(frame, image=image, intrinsics=intrinsics)


class _Feed:
    """A thread that reads the camera as fast as it delivers, and keeps the newest picture only.

    `warn` is called when the camera is lost and when it is found again, from either thread.
    """

    def __init__(self, config: Camera.Config, warn: Callable[[str], None]) -> None:
        self.dropped = 0
        self._warn = warn
        self._taken = 0
        self._config = config
        self._closing = False
        self._fresh = threading.Condition()
        self._newest: tuple[np.ndarray, float] | None = None
        self._capture = _open(config)
        self._thread = threading.Thread(target=self._read, name="camera", daemon=True)
        self._thread.start()

    def newest(self, timeout_s: float) -> tuple[np.ndarray, float] | None:
        """The newest picture that was not taken yet and its time; None when none comes in time."""
        began = time.monotonic()
        warned = self._taken == 0  # the first picture may take its time
        with self._fresh:
            while self._newest is None:
                waited = time.monotonic() - began
                if waited >= timeout_s:
                    return None
                if not warned and waited >= min(SILENT, timeout_s / 2):
                    warned = True
                    self._warn(f"camera {self._config.path} gives no picture: it is waited for up to {timeout_s:g} s")
                self._fresh.wait(min(timeout_s - waited, POLL, timeout_s / 4))
            shot, self._newest = self._newest, None
            self._taken += 1
            return shot

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2 * POLL)  # a read that hangs must not hold the run back: the thread is a daemon

    def _read(self) -> None:
        while not self._closing:
            read, picture = self._capture.read()
            if not read:
                self._reopen()
                continue
            with self._fresh:
                self.dropped += self._newest is not None
                self._newest = picture, time.time()
                self._fresh.notify()
        self._capture.release()

    def _reopen(self) -> None:
        if not self._closing:
            self._warn(f"camera {self._config.path} was lost: it is opened again until it is found")
        self._capture.release()
        while not self._closing:
            time.sleep(RETRY)
            try:
                self._capture = _open(self._config)
            except CameraError:
                continue
            self._warn(f"camera {self._config.path} was lost and found again")
            return


def _open(config: Camera.Config) -> cv2.VideoCapture:
    if Path(config.path).is_file():
        raise CameraError(f"{config.path} is a file and no camera: use dataset=video dataset.path={config.path}")
    if config.path.isdecimal():
        capture = cv2.VideoCapture(int(config.path))
        hint = "is it connected, free of other programs, and may you read it (ls -l /dev/video*)?"
    else:
        milliseconds = int(1000 * config.timeout)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, milliseconds, cv2.CAP_PROP_READ_TIMEOUT_MSEC, milliseconds]
        capture = cv2.VideoCapture(config.path, cv2.CAP_ANY, limits)
        hint = "is the address right (ffplay shows the same one), and does the network let it through?"
    if not capture.isOpened():
        capture.release()
        raise CameraError(f"camera {config.path} cannot be opened: {hint}")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # drivers that queue pictures would deliver old ones
    if config.resolution is not None:
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, config.resolution[0])
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, config.resolution[1])
    if config.fps is not None:
        capture.set(cv2.CAP_PROP_FPS, config.fps)
    return capture
