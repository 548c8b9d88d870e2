"""Lenses of CameraInfo: the part of the sensor that images show, and the pixels of it in one of theirs. Compressed
images of one channel: gray, or the mosaic of a color sensor."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.datasets.ros import lens_of, rectified, rgb_of
from nodes.ros2.messages import CameraInfo, CompressedImage, Header, RegionOfInterest, Time

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


def test_an_ideal_fisheye_is_no_pinhole() -> None:
    for d in (np.zeros(4), np.zeros(0)):
        lens = lens_of(replace(info(), distortion_model="equidistant", d=d), rectified=False)
        assert lens.fisheye
        assert lens.distorted
    assert not lens_of(info(), rectified=False).distorted


def test_rectified_is_a_whole_word() -> None:
    for topic in ("image_rect", "image_rect_color", "image_rect/compressed", "image_rectified", "image/rect"):
        assert rectified(f"/direct/camera/{topic}"), topic
    assert rectified("/camera/rect")
    for topic in ("image_raw", "image_corrected", "image_color_correct", "image/direct"):
        assert not rectified(f"/camera/{topic}"), topic
    assert not rectified("/direct/left")


MOSAIC = np.tile(np.array([[200, 90], [90, 10]], np.uint8), (12, 16))


def compressed(mosaic: np.ndarray, kind: str, encoding: str) -> CompressedImage:
    data = io.BytesIO()
    Image.fromarray(mosaic).save(data, kind)
    return CompressedImage(Header(Time(1, 0), "camera"), encoding, np.frombuffer(data.getvalue(), np.uint8))


@pytest.mark.parametrize("after", ["", " ", " bayer_rggb8"])
def test_a_compressed_mosaic_has_colors(after: str) -> None:
    image = rgb_of(compressed(MOSAIC, "png", f"bayer_rggb8; png compressed{after}"))
    assert image.shape == (24, 32, 3)
    assert image[10, 10].tolist() == [200, 90, 10]
    deep = rgb_of(compressed(MOSAIC.astype(np.uint16) << 8, "png", "bayer_rggb16; png compressed "))
    np.testing.assert_array_equal(deep, image)
    lossy = rgb_of(compressed(MOSAIC, "jpeg", f"bayer_rggb8; jpeg compressed{after}"))
    assert lossy[10, 10].astype(int) == pytest.approx([200, 90, 10], abs=20)


@pytest.mark.parametrize("format_", ["bayer_rggb8; png compressed mono8", "mono8; png compressed ", "png"])
def test_a_compressed_gray_image_stays_gray(format_: str) -> None:
    np.testing.assert_array_equal(rgb_of(compressed(MOSAIC, "png", format_)), np.repeat(MOSAIC[..., None], 3, axis=2))


def test_what_was_compressed_in_color_is_no_mosaic() -> None:
    color = np.full((24, 32, 3), (200, 90, 10), np.uint8)
    for after in ("", "bgr8"):
        np.testing.assert_array_equal(rgb_of(compressed(color, "png", f"bayer_rggb8; png compressed {after}")), color)
