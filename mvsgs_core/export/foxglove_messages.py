"""What a run makes, as Foxglove's messages (https://docs.foxglove.dev/docs/sdk/schemas), which its panels draw.

Axes and conventions are the same as here: a camera looks along z with y down, a pose maps it to its world. `ns` are
nanoseconds of the stream, `frame` names what a message's coordinates are relative to.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransform,
    FrameTransforms,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Pose,
    PoseInFrame,
    PosesInFrame,
    Quaternion,
    RawImage,
    Timestamp,
    Vector3,
)

from mvsgs_core import camera
from mvsgs_core.geometry import quaternion_from_rotation

LATEST = (2**32 - 1) * 10**9  # ns: the last second that their timestamps hold
MAX_IMAGE_PIXELS = 640 * 480  # larger images are sent at that size
JPEG_QUALITY = 80
MAX_KEYFRAME_POINTS = 10_000  # of one keyframe's depth
MAX_MAP_POINTS = 200_000
SH_0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, which a splat's color is in
_AXES, _COLORS = ("x", "y", "z"), ("red", "green", "blue", "alpha")
POINT = np.dtype([(axis, "<f4") for axis in _AXES] + [(color, "u1") for color in _COLORS])
_FIELDS = [
    *(
        PackedElementField(name=x, offset=4 * i, type=PackedElementFieldNumericType.Float32)
        for i, x in enumerate(_AXES)
    ),
    *(
        PackedElementField(name=c, offset=12 + i, type=PackedElementFieldNumericType.Uint8)
        for i, c in enumerate(_COLORS)
    ),
]


def jpeg_size(height: int, width: int) -> tuple[int, int]:
    """(height, width) of the JPEG of an image."""
    return camera.fit_size(height, width, MAX_IMAGE_PIXELS, multiple=1)


def jpeg(ns: int, frame: str, image: np.ndarray) -> CompressedImage:
    """An RGB image (H, W, 3) uint8, at its `jpeg_size`."""
    small = camera.resize_image(image, jpeg_size(*image.shape[:2]))
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return CompressedImage(timestamp=_time(ns), frame_id=frame, data=data, format="jpeg")


def calibration(ns: int, frame: str, intrinsics: np.ndarray, size: tuple[int, int]) -> CameraCalibration:
    """Of images of `size` (height, width), which have no distortion."""
    k = camera.matrix(intrinsics)
    return CameraCalibration(
        timestamp=_time(ns), frame_id=frame, height=size[0], width=size[1], distortion_model="plumb_bob", D=[0.0] * 5,
        K=k.ravel().tolist(), R=np.eye(3).ravel().tolist(), P=np.hstack([k, np.zeros((3, 1))]).ravel().tolist(),
    )  # fmt: skip


def pose(ns: int, frame: str, world_from_cam: np.ndarray) -> PoseInFrame:
    return PoseInFrame(timestamp=_time(ns), frame_id=frame, pose=_pose(world_from_cam))


def poses(ns: int, frame: str, world_from_cam: np.ndarray) -> PosesInFrame:
    """(N, 4, 4), all in one frame."""
    return PosesInFrame(timestamp=_time(ns), frame_id=frame, poses=[_pose(one) for one in world_from_cam])


def transform(ns: int, parent: str, child: str, parent_from_child: np.ndarray) -> FrameTransforms:
    translation, rotation = _parts(parent_from_child)
    one = FrameTransform(
        timestamp=_time(ns), parent_frame_id=parent, child_frame_id=child, translation=translation, rotation=rotation
    )
    return FrameTransforms(transforms=[one])


def depth(ns: int, frame: str, depth: np.ndarray) -> RawImage:
    """A depth map (h, w) as it is: float32 in the map's unit, 0 where not known."""
    height, width = depth.shape
    return RawImage(
        timestamp=_time(ns), frame_id=frame, width=width, height=height, encoding="32FC1", step=4 * width,
        data=np.ascontiguousarray(depth, dtype="<f4").tobytes(),
    )  # fmt: skip


def keyframe_points(
    ns: int,
    frame: str,
    world_from_cam: np.ndarray,
    depth: np.ndarray,
    intrinsics: np.ndarray,
    image: np.ndarray,
) -> PointCloud:
    """The points of a depth map (h, w), on a grid of its pixels, with the colors of its image (H, W, 3).

    At most MAX_KEYFRAME_POINTS, in the camera's axes: the cloud's pose is the camera's. `intrinsics` are the depth
    map's.
    """
    height, width = depth.shape
    step = 1
    while -(-height // step) * -(-width // step) > MAX_KEYFRAME_POINTS:
        step += 1
    points = camera.unproject(depth, intrinsics)[::step, ::step]
    rows, columns = (
        ((np.arange(0, n, step) + 0.5) * (full / n)).astype(int) for n, full in zip(depth.shape, image.shape[:2])
    )
    known = points[..., 2] > 0
    colors = image[rows[:, None], columns[None]][known]
    return _cloud(ns, frame, _pose(world_from_cam), points[known], colors, np.full(len(colors), 255, np.uint8))


def map_points(
    ns: int, frame: str, origin: np.ndarray, means: np.ndarray, sh: np.ndarray, opacity_logits: np.ndarray
) -> PointCloud:
    """The centers of at most MAX_MAP_POINTS splats, spread over the map, with their colors and opacities.

    means (N, 3) relative to `origin` (3,), sh (N, B, 3), opacity_logits (N,).
    """
    step = max(1, -(-len(means) // MAX_MAP_POINTS))
    opacities = 1.0 / (1.0 + np.exp(-opacity_logits[::step].astype(np.float64)))
    at = np.eye(4)
    at[:3, 3] = origin
    return _cloud(ns, frame, _pose(at), means[::step], _bytes(0.5 + SH_0 * sh[::step, 0]), _bytes(opacities))


def _cloud(ns: int, frame: str, at: Pose, points: np.ndarray, colors: np.ndarray, alpha: np.ndarray) -> PointCloud:
    packed = np.empty(len(points), POINT)
    for i, axis in enumerate(_AXES):
        packed[axis] = points[:, i]
    for i, color in enumerate(_COLORS[:3]):
        packed[color] = colors[:, i]
    packed["alpha"] = alpha
    return PointCloud(
        timestamp=_time(ns), frame_id=frame, pose=at, point_stride=POINT.itemsize, fields=_FIELDS, data=packed.tobytes()
    )


def _pose(world_from_cam: np.ndarray) -> Pose:
    position, orientation = _parts(world_from_cam)
    return Pose(position=position, orientation=orientation)


def _parts(pose: np.ndarray) -> tuple[Vector3, Quaternion]:
    x, y, z = pose[:3, 3].tolist()
    qw, qx, qy, qz = quaternion_from_rotation(pose[:3, :3]).tolist()
    return Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)


def _time(ns: int) -> Timestamp:
    return Timestamp(*divmod(ns, 10**9))


def _bytes(values: np.ndarray) -> np.ndarray:
    """0 to 1 -> uint8."""
    return (values.clip(0.0, 1.0) * 255.0).round().astype(np.uint8)
