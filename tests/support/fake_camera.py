"""Stands for OpenCV's camera in tests: it has the next picture when the one before was taken, and none is dropped."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

import nodes.camera
import nodes.stream_presence


class FakeCapture:
    """Stands for cv2.VideoCapture: pictures that are gray with their number. More than one come as `gate` lets them."""

    gate: threading.Semaphore  # pictures that may come
    lost_after: int | None = None  # pictures, then no more until opened again
    dead_after: int | None = None  # pictures over all captures, then never again
    count = -2.8e11  # frames, as OpenCV counts those of a stream without an end
    opened = 0
    pictures = 0

    def __init__(self, *arguments: object) -> None:
        type(self).opened += 1
        self._own = 0

    def isOpened(self) -> bool:
        return self.dead_after is None or self.pictures < self.dead_after

    def read(self) -> tuple[bool, np.ndarray | None]:
        if not self.isOpened() or (self.lost_after is not None and self._own >= self.lost_after):
            return False, None
        self.gate.acquire()
        self._own += 1
        type(self).pictures += 1
        return True, np.full((48, 64, 3), (0, 0, self.pictures % 256), dtype=np.uint8)

    def set(self, *_: object) -> bool:
        return True

    def get(self, what: int) -> float:
        return self.count if what == cv2.CAP_PROP_FRAME_COUNT else 0.0

    def release(self) -> None:
        pass


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[FakeCapture]]:
    class Capture(FakeCapture):
        gate = threading.Semaphore(1)

    feed = nodes.camera._Feed
    newest, close = feed.newest, feed.close

    def taken(self: nodes.camera._Feed, timeout_s: float) -> tuple[np.ndarray, float, int] | None:
        shot = newest(self, timeout_s)
        if shot is not None:
            Capture.gate.release()
        return shot

    def closed(self: nodes.camera._Feed) -> None:
        self._closing.set()
        Capture.gate.release()  # it may be waiting for it
        close(self)

    monkeypatch.setattr(feed, "newest", taken)
    monkeypatch.setattr(feed, "close", closed)
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    monkeypatch.setattr(nodes.stream_presence, "FIRST_PAUSE", 0.01)
    yield Capture
    assert not [t for t in threading.enumerate() if t.name == "camera"], "the capture thread outlived its node"
