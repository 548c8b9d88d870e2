"""What Foxglove finds in a recording: read with the libraries of MCAP alone, by the schemas in the file."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mvsgs_core.geometry import rotation_from_quaternion
from nodes.recorder import ENCODING

SCHEMAS = {
    "/camera/image": "foxglove.CompressedImage",
    "/camera/calibration": "foxglove.CameraCalibration",
    "/camera/pose": "foxglove.PoseInFrame",
    "/tf": "foxglove.FrameTransforms",
    "/keyframe/depth": "foxglove.RawImage",
    "/keyframe/calibration": "foxglove.CameraCalibration",
    "/keyframe/points": "foxglove.PointCloud",
    "/trajectory": "foxglove.PosesInFrame",
    "/map": "foxglove.PointCloud",
}


class Shown(NamedTuple):
    ns: int
    message: Any  # as protobuf's own library reads it, by the schema in the file


def shown(path: Path) -> dict[str, list[Shown]]:
    """What Foxglove finds in a recording, by topic."""
    found: dict[str, list[Shown]] = defaultdict(list)
    factory = DecoderFactory()
    with path.open("rb") as file:
        for schema, channel, record in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            if channel.message_encoding == ENCODING:
                continue
            assert channel.message_encoding == schema.encoding == "protobuf"
            assert schema.name == SCHEMAS[channel.topic.rstrip("_1")]
            decoder = factory.decoder_for(channel.message_encoding, schema)
            assert decoder is not None
            found[channel.topic].append(Shown(record.log_time, decoder(record.data)))
    return dict(found)


def recorded(path: Path) -> list[str]:
    """Topics of the messages that are recorded as they are, in the order of the file."""
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages(log_time_order=False)
        return [channel.topic for _, channel, _ in messages if channel.message_encoding == ENCODING]


def ns(timestamp: float) -> int:
    return round(timestamp * 1e9)


def seconds(stamp: Any) -> float:
    return float(stamp.seconds + stamp.nanos * 1e-9)


def matrix(position: Any, orientation: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(np.array([orientation.w, orientation.x, orientation.y, orientation.z]))
    pose[:3, 3] = position.x, position.y, position.z
    return pose


def points_of(cloud: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the cloud's frame of reference and their colors (N, 4), by the fields that it names."""
    kinds = {1: "u1", 7: "<f4"}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.type] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_stride,
        }
    )
    packed = np.frombuffer(cloud.data, layout)
    local = np.stack([packed[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    at = matrix(cloud.pose.position, cloud.pose.orientation)
    colors = np.stack([packed[name] for name in ("red", "green", "blue", "alpha")], axis=-1)
    return local @ at[:3, :3].T + at[:3, 3], colors
