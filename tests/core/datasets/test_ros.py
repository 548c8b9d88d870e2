"""Lenses of CameraInfo: the part of the sensor that images show, and the pixels of it in one of theirs."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.datasets.ros import lens_of
from nodes.ros2.messages import CameraInfo, Header, RegionOfInterest, Time

K = np.array([600.0, 0, 639.5, 0, 610.0, 479.5, 0, 0, 1])
P = np.array([500.0, 0, 629.5, 0, 0, 510.0, 469.5, 0, 0, 0, 1, 0])


def info(roi: RegionOfInterest | None = None, binning: tuple[int, int] = (0, 0)) -> CameraInfo:
    """Of a sensor of 1280x960."""
    header = Header(Time(1, 0), "camera")
    roi = RegionOfInterest() if roi is None else roi
    return CameraInfo(header, 960, 1280, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), P, *binning, roi)


def test_a_region_of_interest_keeps_the_focal_length() -> None:
    centered = info(RegionOfInterest(320, 240, 480, 640))
    lens = lens_of(centered, rectified=False)
    assert lens.size == (480, 640)
    assert lens.intrinsics == pytest.approx((600.0, 610.0, 319.5, 239.5))
    assert lens_of(centered, rectified=True).intrinsics == pytest.approx((500.0, 510.0, 309.5, 229.5))


def test_binned_pixels_are_larger() -> None:
    lens = lens_of(info(binning=(2, 2)), rectified=False)
    assert lens.size == (480, 640)
    assert lens.intrinsics == pytest.approx((300.0, 305.0, 319.5, 239.5))
    both = lens_of(info(RegionOfInterest(320, 0, 480, 640), (1, 4)), rectified=False)
    assert both.size == (120, 640)
    assert both.intrinsics == pytest.approx((600.0, 152.5, 319.5, 119.5))


def test_without_either_images_show_the_whole_sensor() -> None:
    for whole in (info(), info(binning=(1, 1)), info(RegionOfInterest(0, 0, 960, 1280))):
        assert lens_of(whole, rectified=False).intrinsics == pytest.approx((600.0, 610.0, 639.5, 479.5))


@pytest.mark.parametrize(
    "wrong", [info(RegionOfInterest(700, 0, 960, 640)), info(RegionOfInterest(0, 0, 0, 640)), info(binning=(9999, 1))]
)
def test_what_no_sensor_has_is_refused(wrong: CameraInfo) -> None:
    with pytest.raises(ValueError, match=r"region of interest|0"):
        lens_of(wrong, rectified=False)
