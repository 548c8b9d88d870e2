"""Arrays as messages of ROS 2, in its axes.

Here a camera and the map look along z with y down. In ROS 2 (REP 103) bodies and maps have x forward, y left and z up;
only images and depth maps are in the camera's optical frame, whose axes are ours.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core.camera import matrix
from mvsgs_core.geometry import quaternion_from_rotation
from nodes.ros2.messages import (
    CameraInfo,
    Header,
    Image,
    Point,
    PointCloud2,
    PointField,
    Pose,
    Quaternion,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)

BODY_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
_FIELDS = [PointField(name, 4 * i, PointField.FLOAT32, 1) for i, name in enumerate(("x", "y", "z", "rgb"))]


def body_pose(world_from_cam: np.ndarray, unit: float, turn: np.ndarray = BODY_FROM_OPTICAL) -> np.ndarray:
    """Poses (..., 4, 4) between two frames with our axes -> between the same with ROS's; `unit` is meters in one.

    turn: of the world's axes to ROS's; the identity where they are.
    """
    turned = turn @ world_from_cam @ BODY_FROM_OPTICAL.T
    turned[..., :3, 3] *= unit
    return np.asarray(turned)


def header(at: Time | float, frame: str) -> Header:
    """at: seconds, where no stamp is known."""
    return Header(at if isinstance(at, Time) else Time.of(at), frame)


def poses(parent_from_child: np.ndarray) -> list[Pose]:
    """(N, 4, 4)."""
    orientations = quaternion_from_rotation(parent_from_child[:, :3, :3])[:, [1, 2, 3, 0]].tolist()
    positions = parent_from_child[:, :3, 3].tolist()
    return [Pose(Point(*position), Quaternion(*orientation)) for position, orientation in zip(positions, orientations)]


def transform(at: Time | float, parent: str, child: str, parent_from_child: np.ndarray) -> TransformStamped:
    w, x, y, z = quaternion_from_rotation(parent_from_child[:3, :3]).tolist()
    moved = Transform(Vector3(*parent_from_child[:3, 3].tolist()), Quaternion(x, y, z, w))
    return TransformStamped(header(at, parent), child, moved)


def rgb_image(at: Header, image: np.ndarray) -> Image:
    """(H, W, 3) uint8."""
    height, width = image.shape[:2]
    return Image(at, height, width, "rgb8", 0, 3 * width, image.reshape(-1))


def depth_image(at: Header, depth: np.ndarray) -> Image:
    """(h, w) float32 along z in meters, 0 where it is not known, which REP 118 says by NaN."""
    height, width = depth.shape
    data = np.where(depth > 0, depth, np.nan).astype("<f4")
    return Image(at, height, width, "32FC1", 0, 4 * width, data.view(np.uint8).reshape(-1))


def camera_info(at: Header, intrinsics: np.ndarray, size: tuple[int, int]) -> CameraInfo:
    """Of images (height, width) without distortion."""
    k = matrix(intrinsics)
    p = np.hstack([k, np.zeros((3, 1))])
    return CameraInfo(at, *size, "plumb_bob", np.zeros(5), k.ravel(), np.eye(3).ravel(), p.ravel())


def point_cloud(at: Header, points: np.ndarray, colors: np.ndarray) -> PointCloud2:
    """(N, 3) in the axes and meters of the header's frame, colors (N, 3) uint8 RGB."""
    packed = np.empty(len(points), POINT)
    for i, axis in enumerate("xyz"):
        packed[axis] = points[:, i]
    red, green, blue = colors.astype(np.uint32).T
    packed["rgb"] = red << 16 | green << 8 | blue  # which PCL and RViz read as a float32
    size = POINT.itemsize
    data = packed.view(np.uint8).reshape(-1)
    return PointCloud2(at, 1, len(points), _FIELDS, False, size, size * len(points), data, True)
