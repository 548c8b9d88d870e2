"""Messages of ROS 1 and ROS 2 with small pictures, and bags of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

HEIGHT, WIDTH = 24, 32
K = np.array([40.0, 0, 15.5, 0, 41.0, 11.5, 0, 0, 1])
P = np.array([50.0, 0, 16.5, 0, 0, 51.0, 12.5, 0, 0, 0, 1, 0])
D = (0.1, 0.02, 0.0, 0.0, 0.0)


def picture(number: int) -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[...] = (20 + number, 100, 200)
    return image


class Messages:
    """Messages of either ROS version."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)

    def header(self, seconds: float) -> Any:
        t = self.store.types
        time = t["builtin_interfaces/msg/Time"](int(seconds), round(1e9 * (seconds % 1)))
        header = t["std_msgs/msg/Header"]
        return header(0, time, "camera") if self.ros == 1 else header(time, "camera")

    def image(self, number: int, encoding: str, data: np.ndarray, step: int) -> Any:
        cls = self.store.types["sensor_msgs/msg/Image"]
        return cls(self.header(100 + number / 10), HEIGHT, WIDTH, encoding, 0, step, data.ravel())

    def compressed(self, number: int, data: bytes) -> Any:
        cls = self.store.types["sensor_msgs/msg/CompressedImage"]
        return cls(self.header(100 + number / 10), "png", np.frombuffer(data, dtype=np.uint8))

    def info(self) -> Any:
        t = self.store.types
        region = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        cls = t["sensor_msgs/msg/CameraInfo"]
        return cls(
            self.header(100), HEIGHT, WIDTH, "plumb_bob", np.array(D), K.copy(), np.eye(3).ravel(), P, 0, 0, region
        )

    def write(self, path: Path, messages: list[tuple[str, float, Any]]) -> Path:
        with Writer1(path) if self.ros == 1 else Writer2(path, version=9) as writer:
            self.write_into(writer, messages)
        return path

    def write_into(self, writer: Writer1 | Writer2, messages: list[tuple[str, float, Any]]) -> None:
        connections: dict[str, Any] = {}
        serialize = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        for topic, seconds, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
            writer.write(connections[topic], int(1e9 * seconds), serialize(message, kind))


def walk(ros: Messages, path: Path, frames: int = 6) -> Path:
    images = [("/camera/image_raw", 1.0 + i, ros.image(i, "rgb8", picture(i), 3 * WIDTH)) for i in range(frames)]
    return ros.write(path, [("/camera/camera_info", 1.0, ros.info()), *images])


def write_walk(ros: Messages, writer: Writer1 | Writer2, frames: Iterable[int] = range(6)) -> None:
    """Calibration and images into a bag that is open."""
    ros.write_into(writer, [("/c/camera_info", 1.0, ros.info()), *images_of(ros, frames)])


def images_of(ros: Messages, frames: Iterable[int] = range(6)) -> list[tuple[str, float, Any]]:
    return [("/c/image_raw", 2.0 + i, ros.image(i, "rgb8", picture(i), 3 * WIDTH)) for i in frames]
