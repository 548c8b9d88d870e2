"""ROS 2 over DDS on loopback, between two processes: `python -m bench.ros2`.

Images of 640x480 at 30 frames a second go from a camera in another process, written as our publisher writes them, to
the node of dataset=ros2. Processor time is of all threads of a process, Cyclone's too, over the frames of a run. Bytes
are compared with rosbags' serialization. No program of ROS 2 itself takes part.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import multiprocessing
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection as Pipe
from typing import Any

import cv2
import numpy as np
from PIL import Image as Picture

from bench.table import Row, all_of, at_most, main, skipped, timed
from msgs import CameraPose, Frame, FusedKeyframe, Keyframe, Preview
from nodes.ros2 import forms, messages
from nodes.ros2.cdr import encode
from nodes.ros2.connection import DEFAULT, SENSOR_DATA, Connection
from nodes.ros2.messages import CameraInfo, CompressedImage, Header, Image, Time
from nodes.ros2_camera import Ros2Camera
from nodes.ros2_publisher import Ros2Publisher

SIZE = 480, 640
RATE = 30.0  # frames a second
GOAL = 5.0  # ms of processor time for an image, each way
FRESH = 4  # images in turn
DOMAIN = 100 + os.getpid() % 100
INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])


@dataclass(frozen=True)
class Way:
    """How images travel."""

    name: str
    reliable: bool = False
    compressed: bool = False
    distortion: tuple[float, ...] = ()


WAYS = (
    Way("best effort"), Way("reliable", reliable=True), Way("with distortion", distortion=(-0.05, 0.01, 0.0, 0.0, 0.0)),
    Way("JPEG", compressed=True),
)  # fmt: skip


@dataclass
class Sent:
    count: int
    milliseconds: float  # of processor time for each
    refused: int  # by a reader that was too slow


@dataclass
class Taken:
    milliseconds: float = 0.0  # of processor time for each
    latencies: list[float] = field(default_factory=list)  # s
    passed_over: int = 0  # a newer one was there already


def send(way: Way, seconds: float, domain: int, pipe: Pipe) -> None:
    """The camera's process."""
    from nodes.ros2.dds import Participant

    participant = Participant(Connection(domain=domain))
    quality = DEFAULT if way.reliable else SENSOR_DATA
    topic = "/camera/image_raw" + ("/compressed" if way.compressed else "")
    kind: Any = CompressedImage if way.compressed else Image
    images, infos = (
        participant.writer(topic, kind, quality),
        participant.writer("/camera/camera_info", CameraInfo, quality),
    )
    pictures = [_picture(seed) for seed in range(FRESH)]
    files = [_jpeg(picture) for picture in pictures]
    while not (images.readers and infos.readers):
        time.sleep(0.02)
    count, refused = round(RATE * seconds), 0
    began, used = time.monotonic(), time.process_time()
    for number in range(count):
        time.sleep(max(0.0, began + number / RATE - time.monotonic()))
        at = Header(Time.of(time.time()), "camera")
        info = forms.camera_info(at, INTRINSICS, SIZE)
        infos.write(dataclasses.replace(info, d=np.array(way.distortion)))
        if way.compressed:
            message: Any = CompressedImage(at, "jpeg", files[number % FRESH])
        else:
            message = forms.rgb_image(at, pictures[number % FRESH])
        refused += not images.write(message)
    pipe.send(Sent(count, 1e3 * (time.process_time() - used) / count, refused))
    pipe.recv()  # until all is taken


def run(way: Way, seconds: float) -> tuple[Sent, Taken]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=send, args=(way, seconds, DOMAIN, theirs))
    process.start()
    topic = "/camera/image_raw" + ("/compressed" if way.compressed else "")
    node = Ros2Camera(Ros2Camera.Config(path=topic, domain=DOMAIN, reliable=way.reliable, timeout=20.0))
    taken = Taken()
    used = 0.0
    stream = node.run()
    for message in stream:
        if not isinstance(message, Frame):
            continue
        node.config.timeout = 2.0  # the stream has begun: from now on silence is its end
        taken.latencies.append(time.time() - message.timestamp)
        used = used or time.process_time()
        taken.milliseconds = 1e3 * (time.process_time() - used) / max(1, len(taken.latencies) - 1)
    taken.passed_over = int(node.stats.counts.get("dropped", 0) + node.stats.counts.get("before_calibration", 0))
    sent: Sent = ours.recv()
    ours.send("done")
    process.join()
    return sent, taken


def rows_of(way: Way, seconds: float) -> list[Row]:
    sent, taken = run(way, seconds)
    arrived = len(taken.latencies) + taken.passed_over
    name = f"640x480, {way.name}"
    latencies = 1e3 * np.array(taken.latencies)
    return [
        at_most(f"{name}: out, processor time", sent.milliseconds, "ms/image", GOAL),
        at_most(f"{name}: in, processor time", taken.milliseconds, "ms/image", GOAL),
        at_most(f"{name}: lost in {seconds:.0f} s at {RATE:.0f} frames/s", sent.count - arrived, f"of {sent.count}", 0),
        Row(f"{name}: passed over for a newer one", taken.passed_over, f"of {sent.count}"),
        Row(f"{name}: from the stamp to the frame, median", float(np.median(latencies)), "ms"),
        Row(f"{name}: from the stamp to the frame, 99th percentile", float(np.quantile(latencies, 0.99)), "ms"),
    ]


def bytes_of_rosbags() -> list[Row]:
    """Every type against rosbags, in both byte orders."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return [skipped("message types whose bytes equal rosbags'", "pip install rosbags")]
    store = get_typestore(Stores.ROS2_HUMBLE)

    def theirs(message: Any) -> Any:
        values = {f.name: getattr(message, f.name) for f in dataclasses.fields(message)}
        for name, value in values.items():
            if dataclasses.is_dataclass(value):
                values[name] = theirs(value)
            elif isinstance(value, list):
                values[name] = [theirs(each) for each in value]
        return store.types[message.ros](**values)

    equal, examples = 0, _examples()
    for message in examples:
        equal += all(
            encode(message, big) == bytes(store.serialize_cdr(theirs(message), message.ros, little_endian=not big))
            for big in (False, True)
        )
    return [all_of("message types whose bytes equal rosbags', both byte orders", equal, len(examples))]


def _examples() -> list[Any]:
    """One of each type that is read or written."""
    at = Header(Time(7, 8), "camera")
    (pose,) = forms.poses(np.eye(4)[None])
    transform = forms.transform(7.0, "map", "odom", np.eye(4))
    stamped = messages.PoseStamped(at, pose)
    image = _picture(0)[:5, :7]
    return [
        at.stamp, at, forms.rgb_image(at, np.ascontiguousarray(image)), CompressedImage(at, "jpeg", _jpeg(image)),
        forms.camera_info(at, INTRINSICS, SIZE), messages.RegionOfInterest(1, 2, 3, 4, True),
        forms.point_cloud(at, np.eye(3), np.eye(3, dtype=np.uint8)), messages.PointField("x", 0, 7, 1), pose.position,
        pose.orientation, pose, stamped, messages.Path(at, [stamped, stamped]), transform.transform.translation,
        transform.transform, transform, messages.TFMessage([transform]),
    ]  # fmt: skip


def rows_of_publisher(repeats: int) -> list[Row]:
    """Processor time of what is published: made and written. Only the path has a reader, without which none is made."""
    from nodes.ros2.dds import Participant

    node = Ros2Publisher(Ros2Publisher.Config(domain=DOMAIN))
    reader = Participant(Connection(domain=DOMAIN)).reader("/mvsgs/path", messages.Path, DEFAULT)
    while not reader.writers:
        time.sleep(0.02)
    image, intrinsics = _picture(0), INTRINSICS
    rng = np.random.default_rng(0)
    means, colors = rng.normal(size=(100000, 3)).astype(np.float32), rng.integers(0, 255, (100000, 3), np.uint8)
    small, none = np.zeros((2, 2, 3), np.uint8), np.zeros((0, 3, 3), np.float32)
    depth = rng.random(SIZE, np.float32)
    normals = np.zeros((*SIZE, 3), np.float32)
    blank = np.zeros((60, 80), np.float32)
    for index in range(1000):
        pose = np.eye(4)
        pose[0, 3] = index
        list(node.on_keyframe(Keyframe(index, float(index), small, intrinsics, pose, 1.0, blank, blank, 0)))

    def pose_of(k: int) -> Any:
        return node.on_camera_pose(CameraPose(2000 + k, 2000.0 + k, np.eye(4), 0, np.eye(4)))

    def path_of(k: int) -> Any:
        return node.on_keyframe(Keyframe(1001, 1001.0, small, intrinsics, np.eye(4), 1.0, blank, blank, 0))

    def depth_of(k: int) -> Any:
        return node.on_fused_keyframe(
            FusedKeyframe(5, 5.0, image, intrinsics, np.eye(4), 1.0, depth, depth, normals, 0)
        )  # fmt: skip

    def points_of(k: int) -> Any:
        return node.on_preview(
            Preview(0, k, np.eye(4), np.ones(4), small, small, means, none, colors, np.ones(len(means), np.float32))
        )

    def times(make: Callable[[int], Any]) -> list[float]:
        found = []
        for k in range(repeats):
            before = time.process_time()
            list(make(k))
            found.append(1e3 * (time.process_time() - before))
        return found

    return [
        timed("publisher: pose and transforms of a frame", times(pose_of), "ms"),
        timed("publisher: path of 1,000 keyframes, for a reader", times(path_of), "ms"),
        timed("publisher: depth map of 640x480 with its calibration", times(depth_of), "ms"),
        timed("publisher: map of 100,000 points", times(points_of), "ms"),
    ]


def _picture(seed: int) -> np.ndarray:
    """Smooth, as photographs are: noise would be the worst of JPEGs."""
    rough = np.random.default_rng(seed).integers(0, 255, (30, 40, 3), np.uint8)
    return np.asarray(cv2.resize(rough, (SIZE[1], SIZE[0]), interpolation=cv2.INTER_CUBIC))


def _jpeg(picture: np.ndarray) -> np.ndarray:
    data = io.BytesIO()
    Picture.fromarray(picture).save(data, "JPEG", quality=90)
    return np.frombuffer(data.getvalue(), np.uint8)


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    rows = bytes_of_rosbags()
    try:
        from nodes.ros2 import dds
    except ImportError as error:
        return rows + [skipped(name, f"pip install cyclonedds ({error})") for name in ("640x480", "publisher")]
    assert dds
    for way in WAYS:
        rows += rows_of(way, 4.0 if options.quick else 60.0)
    return rows + rows_of_publisher(5 if options.quick else 20)


if __name__ == "__main__":
    main(measure, "ROS 2 over DDS on loopback")
