"""A camera of this machine by a stable name: a link that udev makes, which leads to another device after each plug."""

from __future__ import annotations

import os
import sys
from typing import Any

import cv2
import numpy as np
import pytest

import nodes.camera
import nodes.stream_presence
from msgs import Frame
from nodes.camera import Camera, CameraError

LINK = "/dev/v4l/by-id/usb-eye-index0"


def test_a_link_is_followed_anew_at_each_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = iter(["/dev/video2", LINK, "/dev/video4"])  # unplugged, and plugged in elsewhere
    opened: list[tuple[Any, ...]] = []

    class Capture:
        """Three pictures, then no more."""

        def __init__(self, *arguments: Any) -> None:
            opened.append(arguments)
            self._left = 3

        def isOpened(self) -> bool:
            return True

        def read(self) -> tuple[bool, np.ndarray | None]:
            self._left -= 1
            return self._left >= 0, np.full((48, 64, 3), 10 * len(opened) + self._left, np.uint8)

        def set(self, *_: object) -> bool:
            return True

        def get(self, what: int) -> float:
            return -1.0 if what == cv2.CAP_PROP_FRAME_COUNT else 0.0

        def release(self) -> None:
            pass

    real = os.path.realpath
    monkeypatch.setattr("os.path.realpath", lambda path: next(devices, "/dev/video4") if path == LINK else real(path))
    monkeypatch.setattr(nodes.camera.cv2, "VideoCapture", Capture)
    monkeypatch.setattr(nodes.stream_presence, "FIRST_PAUSE", 0.01)
    camera = Camera(Camera.Config(path=LINK, timeout=5.0))
    stream = camera.run()
    while len(opened) < 2:
        assert isinstance(next(stream), Frame)
        next(stream)
    stream.close()
    assert opened[:2] == [(2,), (4,)]  # what is not there is not opened as an address


@pytest.mark.skipif(sys.platform != "linux", reason="devices have other names")
def test_a_link_that_is_not_there_is_named() -> None:
    config = Camera.Config(path="/dev/v4l/by-id/no-such-eye")
    with pytest.raises(CameraError, match="by-id/no-such-eye does not exist"):
        Camera.check(config)
    with pytest.raises(CameraError, match="it does not exist"):
        next(iter(Camera(config).run()))
