"""A camera that is lost within a run: the stream goes on when it is back, and the tracker in the same map."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import nodes.camera
import nodes.stream_presence
from launch.compose import compose
from launch.inline import run_inline
from msgs import GroundTruth, Trajectory
from mvsgs_core.datasets import open_dataset
from mvsgs_core.geometry import umeyama

pytestmark = pytest.mark.slow

LOST = None  # in the place of a picture: a read, or an attempt to open it, that fails
SIZE = (120, 160)


class Script:
    """What a camera does, one picture after the other as they are taken: none is dropped."""

    def __init__(self, pictures: list[np.ndarray | None]) -> None:
        self._left = pictures
        self._taken = threading.Semaphore(1)

    def taken(self) -> None:
        self._taken.release()

    def opens(self) -> bool:
        if self._left and self._left[0] is LOST:
            del self._left[0]
            return False
        return True

    def picture(self) -> tuple[bool, np.ndarray | None]:
        if not self._left or self._left[0] is LOST or not self._taken.acquire(timeout=30.0):
            return False, None
        return True, self._left.pop(0)


def test_the_map_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    items = list(open_dataset("synthetic", size=list(SIZE), frames=120))
    order = [*range(50), LOST, LOST, LOST, *range(30, 60)]  # carried back to where it has been
    pictures = [LOST if i is LOST else np.asarray(cv2.cvtColor(items[i].image, cv2.COLOR_RGB2BGR)) for i in order]
    shown = [i for i in order if i is not LOST]
    script = Script(pictures)

    class Capture:
        def __init__(self, *_: object) -> None:
            self.isOpened = script.opens
            self.read = script.picture

        def set(self, *_: object) -> bool:
            return True

        def release(self) -> None:
            pass

    monkeypatch.setattr(nodes.camera.cv2, "VideoCapture", Capture)
    monkeypatch.setattr(nodes.stream_presence, "FIRST_PAUSE", 0.05)
    tracks: list[Trajectory] = []

    def observe(slot: str, node: object, message: Any) -> None:
        if isinstance(message, GroundTruth):
            script.taken()
        if isinstance(message, Trajectory):
            tracks.append(message)

    off = [f"{slot}._target_=null" for slot in ("mvs", "depth_fusion", "mapper", "evaluator")]
    overrides = [
        "dataset=camera", f"dataset.intrinsics={items[0].intrinsics.tolist()}", f"dataset.stop={len(shown)}",
        "device=cpu", "tracker.threads=1", f"output={tmp_path}",
    ]  # fmt: skip
    camera = run_inline(compose([*overrides, *off]), observe)["dataset"]
    said = [text for text in camera.stats.warnings if "loss 1" in text]
    assert said[0].startswith("camera 0 was lost (it gives no picture")
    assert said[1].startswith("camera 0 is back after")
    assert camera.stats.counts["frames"] == len(shown)
    (track,) = tracks
    assert np.isfinite(track.world_from_cam).all()
    assert set(track.segment.tolist()) == {0}
    true = np.array([items[i].world_from_cam[:3, 3] for i in shown])
    found = track.world_from_cam[:, :3, 3]
    aligned = umeyama(found, true).apply(found)
    errors = np.linalg.norm(aligned - true, axis=1)
    path = np.linalg.norm(np.diff(true[:50], axis=0), axis=1).sum()
    assert np.median(errors[:50]) < 0.005 * path
    assert np.median(errors[50:]) < 1.5 * np.median(errors[:50]) + 0.001 * path
