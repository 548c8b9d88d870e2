"""The ROS 2 messages that are read and written here, field by field as their .msg files have them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Protocol

import numpy as np

Bool = Annotated[bool, "?"]
UInt8 = Annotated[int, "u1"]
Int32 = Annotated[int, "i4"]
UInt32 = Annotated[int, "u4"]
Float64 = Annotated[float, "f8"]
Bytes = Annotated[np.ndarray, "u1", None]


class Message(Protocol):
    ros: ClassVar[str]  # its name in ROS


@dataclass(frozen=True)
class Time:
    sec: Int32
    nanosec: UInt32

    ros: ClassVar[str] = "builtin_interfaces/msg/Time"

    @classmethod
    def of(cls, seconds: float) -> Time:
        """The time nearest to so many seconds, in whole microseconds: a float of today's times has no nanoseconds."""
        return cls.at(1000 * round(seconds * 1e6))

    @classmethod
    def at(cls, nanoseconds: int) -> Time:
        """Those that ROS 2 cannot say are its first or last."""
        nanoseconds = min(max(nanoseconds, 0), 2**31 * 10**9 - 1)
        return cls(nanoseconds // 10**9, nanoseconds % 10**9)

    @property
    def nanoseconds(self) -> int:
        return self.sec * 10**9 + self.nanosec


@dataclass(frozen=True)
class Header:
    stamp: Time
    frame_id: str

    ros: ClassVar[str] = "std_msgs/msg/Header"


@dataclass(frozen=True, eq=False)
class Image:
    header: Header
    height: UInt32
    width: UInt32
    encoding: str
    is_bigendian: UInt8
    step: UInt32  # bytes a row
    data: Bytes

    ros: ClassVar[str] = "sensor_msgs/msg/Image"


@dataclass(frozen=True, eq=False)
class CompressedImage:
    header: Header
    format: str
    data: Bytes

    ros: ClassVar[str] = "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True)
class RegionOfInterest:
    x_offset: UInt32 = 0
    y_offset: UInt32 = 0
    height: UInt32 = 0
    width: UInt32 = 0
    do_rectify: Bool = False

    ros: ClassVar[str] = "sensor_msgs/msg/RegionOfInterest"


@dataclass(frozen=True, eq=False)
class CameraInfo:
    header: Header
    height: UInt32
    width: UInt32
    distortion_model: str
    d: Annotated[np.ndarray, "f8", None]
    k: Annotated[np.ndarray, "f8", 9]
    r: Annotated[np.ndarray, "f8", 9]
    p: Annotated[np.ndarray, "f8", 12]
    binning_x: UInt32 = 0
    binning_y: UInt32 = 0
    roi: RegionOfInterest = field(default_factory=RegionOfInterest)

    ros: ClassVar[str] = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True)
class PointField:
    name: str
    offset: UInt32
    datatype: UInt8
    count: UInt32

    ros: ClassVar[str] = "sensor_msgs/msg/PointField"

    FLOAT32: ClassVar[int] = 7


@dataclass(frozen=True, eq=False)
class PointCloud2:
    header: Header
    height: UInt32
    width: UInt32
    fields: list[PointField]
    is_bigendian: Bool
    point_step: UInt32
    row_step: UInt32
    data: Bytes
    is_dense: Bool

    ros: ClassVar[str] = "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True)
class Point:
    x: Float64
    y: Float64
    z: Float64

    ros: ClassVar[str] = "geometry_msgs/msg/Point"


@dataclass(frozen=True)
class Vector3:
    x: Float64
    y: Float64
    z: Float64

    ros: ClassVar[str] = "geometry_msgs/msg/Vector3"


@dataclass(frozen=True)
class Quaternion:
    x: Float64
    y: Float64
    z: Float64
    w: Float64

    ros: ClassVar[str] = "geometry_msgs/msg/Quaternion"


@dataclass(frozen=True)
class Pose:
    position: Point
    orientation: Quaternion

    ros: ClassVar[str] = "geometry_msgs/msg/Pose"


@dataclass(frozen=True)
class PoseStamped:
    header: Header
    pose: Pose

    ros: ClassVar[str] = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True)
class Path:
    header: Header
    poses: list[PoseStamped]

    ros: ClassVar[str] = "nav_msgs/msg/Path"


@dataclass(frozen=True)
class Transform:
    translation: Vector3
    rotation: Quaternion

    ros: ClassVar[str] = "geometry_msgs/msg/Transform"


@dataclass(frozen=True)
class TransformStamped:
    header: Header
    child_frame_id: str
    transform: Transform

    ros: ClassVar[str] = "geometry_msgs/msg/TransformStamped"


@dataclass(frozen=True)
class TFMessage:
    transforms: list[TransformStamped]

    ros: ClassVar[str] = "tf2_msgs/msg/TFMessage"
