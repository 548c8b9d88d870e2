"""ROS 1 and ROS 2 image and camera messages, as `rosbags` gives them, to arrays and lenses."""

from __future__ import annotations

import io
import re
from pathlib import PurePosixPath
from typing import Any

import cv2
import numpy as np

from mvsgs_core.bad_file import brief
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.datasets.files import MAX_PIXELS, UnreadableImageError, opened_image, read_image
from mvsgs_core.datasets.lens import Lens

# channels a pixel, bits a channel, conversion to RGB (None: it is)
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "rgb8": (3, 8, None),
    "bgr8": (3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, 8, cv2.COLOR_BGRA2RGB),
    "8UC3": (3, 8, cv2.COLOR_BGR2RGB),
    "8UC4": (4, 8, cv2.COLOR_BGRA2RGB),
    "rgb16": (3, 16, None),
    "bgr16": (3, 16, cv2.COLOR_BGR2RGB),
    "rgba16": (4, 16, cv2.COLOR_RGBA2RGB),
    "bgra16": (4, 16, cv2.COLOR_BGRA2RGB),
    "mono8": (1, 8, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, 8, cv2.COLOR_GRAY2RGB),
    "mono16": (1, 16, cv2.COLOR_GRAY2RGB),
    # ROS names a Bayer pattern by its first row, OpenCV by its second row and column
    "bayer_rggb8": (1, 8, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, 8, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, 8, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, 8, cv2.COLOR_BayerGB2RGB),
    "bayer_rggb16": (1, 16, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr16": (1, 16, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg16": (1, 16, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg16": (1, 16, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
}
# what image_transport compresses without a conversion: "bayer_rggb8; jpeg compressed "
_MOSAIC = re.compile(r"(bayer_[bgr]{4})(?:8|16) *; *\w+ +compressed *(?:bayer_\w+ *)?")
COMPRESSED = "/compressed"  # after the topic of images: the same as CompressedImage
_RADIAL = ("plumb_bob", "rational_polynomial", "")
_FISHEYE = ("equidistant", "fisheye")


def rgb_of(message: Any) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a sensor_msgs Image or CompressedImage.

    Raises UnreadableImageError for damaged data or an encoding that is no color or gray image.
    """
    if hasattr(message, "encoding"):
        return _raw(message)
    name = f"compressed image ({brief(ValueError(message.format))})"
    data = bytes(message.data)
    image = read_image(io.BytesIO(data), name=name, turn_upright=False)
    mosaic = _MOSAIC.fullmatch(message.format)
    if mosaic is None:
        return image
    with opened_image(io.BytesIO(data), name) as opened:
        channels = len(opened.getbands())
    return image if channels > 1 else _in_rgb(image[..., 0], f"{mosaic[1]}8")


def _raw(message: Any) -> np.ndarray:
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise UnreadableImageError(
            f"encoding {str(message.encoding)[:40]!r} is no color or gray image; known are {known}"
        )
    channels, bits, _ = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * bits // 8
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    if height < 1 or row < 1 or step < row or data.size < step * (height - 1) + row:
        raise UnreadableImageError(f"{data.size} bytes are no {width}x{height} image in {message.encoding}")
    if height * width > MAX_PIXELS:
        raise UnreadableImageError(f"{width}x{height} pixels, more than {MAX_PIXELS}")
    padded = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))  # the last row may lack its padding
    rows = np.ascontiguousarray(padded)
    if bits == 16:
        rows = (rows.view(">u2" if message.is_bigendian else "<u2") >> 8).astype(np.uint8)
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows.reshape(height, width)
    return _in_rgb(pixels, message.encoding)


def _in_rgb(pixels: np.ndarray, encoding: str) -> np.ndarray:
    conversion = _ENCODINGS[encoding][2]
    try:
        return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
    except cv2.error as error:  # a pattern of two by two pixels in an image of one row
        height, width = pixels.shape[:2]
        raise UnreadableImageError(f"a {width}x{height} image in {encoding}: {brief(error)}") from error


def seconds_of(message: Any, nanoseconds: int) -> float:
    """The time stamp of a message's header; that of who received it, in nanoseconds, where the header has none."""
    stamp = message.header.stamp
    seconds = stamp.sec + 1e-9 * stamp.nanosec
    return float(seconds) if seconds > 0 else 1e-9 * nanoseconds


def camera_info_topic(topic: str) -> str:
    """Where the calibration of images is by ROS's custom: beside them, whatever transport they come by."""
    return str(PurePosixPath(topic.removesuffix(COMPRESSED)).parent / "camera_info")


def rectified(topic: str) -> bool:
    """Whether images are undistorted already, by ROS's names for them: image_rect, image_rect_color."""
    return re.search(r"(^|[/_])rect(ified)?([/_]|$)", topic.split("image")[-1]) is not None


def calibrated(info: Any) -> bool:
    """Whether a sensor_msgs CameraInfo says anything: drivers of cameras that nobody calibrated send zeros."""
    k = np.asarray(getattr(info, "k", getattr(info, "K", None)), dtype=np.float64)
    return bool(k[0] > 0 and min(int(info.height), int(info.width)) > 0)


def lens_of(info: Any, rectified: bool) -> Lens:
    """The lens, for images as they come, of a `calibrated` sensor_msgs CameraInfo.

    rectified: ROS has undistorted them already. Raises ValueError if the distortion model is unknown, or the numbers
    are no camera's.
    """
    d, k, p = (np.asarray(getattr(info, name, getattr(info, name.upper(), None)), dtype=np.float64) for name in "dkp")
    if rectified:
        of_sensor = (p[0], p[5], p[2], p[6]) if p[0] > 0 else (k[0], k[4], k[2], k[5])
        return Lens(*_in_view(info, of_sensor))
    if info.distortion_model not in (*_RADIAL, *_FISHEYE):
        raise ValueError(
            f"distortion model {info.distortion_model!r} is unknown; known are {(*_RADIAL[:2], *_FISHEYE)}"
        )
    intrinsics, size = _in_view(info, (k[0], k[4], k[2], k[5]))
    return Lens(intrinsics, size, tuple(float(v) for v in d), info.distortion_model in _FISHEYE)


def _in_view(info: Any, intrinsics: tuple[float, ...]) -> tuple[tuple[float, float, float, float], tuple[int, int]]:
    """Intrinsics and size of the images where (fx, fy, cx, cy) are the whole sensor's: of its pixels they have the
    region of interest, all for one of width 0, with `binning` of them in one."""
    fx, fy, cx, cy = intrinsics
    height, width = int(info.height), int(info.width)
    region = info.roi
    if region.width > 0:
        left, top = int(region.x_offset), int(region.y_offset)
        if left + int(region.width) > width or top + int(region.height) > height:
            raise ValueError(f"its region of interest is not inside the {width}x{height} pixels that it is for")
        cx, cy, height, width = cx - left, cy - top, int(region.height), int(region.width)
    bins = max(1, int(info.binning_y)), max(1, int(info.binning_x))
    fx, fy, cx, cy = scale_intrinsics(np.array([fx, fy, cx, cy]), bins, (1, 1)).tolist()
    return (fx, fy, cx, cy), (height // bins[0], width // bins[1])
