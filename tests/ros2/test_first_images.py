"""dataset=ros2 as a stream begins: calibrations that bend too much, images before a simulation has a clock."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core.datasets.ros import lens_of
from nodes.ros2.cdr import decode, encode
from nodes.ros2.messages import CameraInfo, Header, Image, RegionOfInterest, Time
from nodes.ros2_camera import Ros2Camera

K = np.array([25.0, 0, 15.5, 0, 25.0, 11.5, 0, 0, 1])


def info(k1: float) -> CameraInfo:
    d = np.array([k1, 0, 0, 0, 0])
    header = Header(Time(0, 0), "camera")
    return CameraInfo(header, 24, 32, "plumb_bob", d, K, np.eye(3).ravel(), np.zeros(12), 0, 0, RegionOfInterest())


def node(infos: list[CameraInfo], **other: Any) -> Ros2Camera:
    """One that is not in the network: these calibrations have come."""
    camera = Ros2Camera(Ros2Camera.Config(**other))
    camera._images = SimpleNamespace(decode=lambda data: decode(Image, data))  # type: ignore[assignment]
    camera._infos = SimpleNamespace(take=lambda: infos, decode=lambda given: given)  # type: ignore[assignment]
    return camera


def image(seconds: int, height: int = 24, width: int = 32) -> bytes:
    pixels = np.full(height * width, 50, np.uint8)
    return encode(Image(Header(Time(seconds, 0), "camera"), height, width, "mono8", 0, width, pixels))


def test_a_distortion_that_cannot_be_taken_out_is_refused() -> None:
    camera = node([info(1000.0), info(0.01)])
    frame = camera._frame(image(7))
    assert camera._lens == lens_of(info(0.01), rectified=False)
    assert camera.stats.counts["refused_calibrations"] == 1
    assert frame is not None
    assert camera._framed(frame).image.shape == (24, 32, 3)


def test_what_is_said_of_the_lens_is_in_pixels_of_the_images() -> None:
    """As `dataset.intrinsics` is given, of whatever size the calibration is for."""
    camera = node([info(0.0)])
    frame = camera._frame(image(7, 48, 64))
    assert frame is not None
    assert camera.stats.values["lens"]["size"] == [48, 64]
    assert camera.stats.values["lens"]["intrinsics"] == frame.intrinsics.tolist() == [50.0, 50.0, 31.5, 23.5]


def test_such_a_distortion_holds_where_the_border_is_cut_off() -> None:
    camera = node([info(1000.0)], crop=2)
    assert camera._frame(image(7)) is not None
    assert not camera.stats.counts


def test_first_images_without_a_stamp_do_not_set_the_clock() -> None:
    camera = node([info(0.0)])
    assert [camera._frame(image(0)) for _ in range(3)] == [None, None, None]
    assert camera.stats.counts == {"unusable": 3}
    frame = camera._frame(image(7))
    assert frame is not None
    assert frame.stamp == 7 * 10**9


def test_a_stream_without_stamps_has_the_time_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.ros2_camera.UNSTAMPED", 0.05)
    camera = node([info(0.0)])
    assert camera._frame(image(0)) is None
    time.sleep(0.06)
    began = time.time_ns()
    for _ in range(2):
        frame = camera._frame(image(0))
        assert frame is not None
        assert began <= frame.stamp <= time.time_ns()


@pytest.mark.parametrize("stamps", [[7, 0, 8], [7, 8, 0]])
def test_one_without_a_stamp_among_others_is_left_out(stamps: list[int]) -> None:
    camera = node([info(0.0)])
    frames = [frame for stamp in stamps if (frame := camera._frame(image(stamp))) is not None]
    assert [frame.timestamp for frame in frames] == [7.0, 8.0]
