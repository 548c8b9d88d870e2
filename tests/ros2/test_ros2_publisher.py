"""publisher=ros2: what another process gets over DDS, in ROS's axes and frames of reference."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from msgs import Asked, CameraPose, FusedKeyframe, Keyframe, Poses, Preview, Reply, Request
from mvsgs_core import geometry
from nodes.odometry import Odometry
from nodes.ros2_publisher import Frames, Ros2Publisher
from tests.support.patience import until
from tests.support.ros2_peer import OWN_DOMAIN, Peer

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow

TYPES = {
    "pose": "geometry_msgs/msg/PoseStamped", "path": "nav_msgs/msg/Path", "points": "sensor_msgs/msg/PointCloud2",
    "depth/image": "sensor_msgs/msg/Image", "depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "tf": "tf2_msgs/msg/TFMessage", "tf_static": "tf2_msgs/msg/TFMessage",
}  # fmt: skip
KEPT = ("points", "tf_static")
_numbers = count()


class Graph:
    """A publisher in a namespace of its own, and what a program gets of it."""

    def __init__(self, peer: Peer, **config: Any) -> None:
        self.space = f"/robot_{next(_numbers)}"
        topics = {"tf": f"{self.space}/tf", "tf_static": f"{self.space}/tf_static"}
        config = {"domain": OWN_DOMAIN, "namespace": self.space} | config
        self._peer = peer
        for name, kind in TYPES.items():
            quality = {"transient_local": name in KEPT, "depth": 100}
            peer.subscribe(self.topic(name), kind, **quality)
        from nodes.ros2_publisher import Topics

        self.node = Ros2Publisher(Ros2Publisher.Config(topics=Topics(**topics), **config))
        writers = (
            self.node._pose,
            self.node._path,
            self.node._depth,
            self.node._info,
            self.node._tf,
            self.node._points,
        )
        until(lambda: all(writer is not None and writer.readers for writer in writers))

    def topic(self, name: str) -> str:
        return f"{self.space}/{name}" if name.startswith("tf") else f"{self.space}/mvsgs/{name}"

    def taken(self, name: str, count: int = 1) -> list[dict[str, Any]]:
        return self._peer.wait_for(self.topic(name), count)

    def none(self, name: str) -> None:
        time.sleep(0.2)
        assert self._peer.taken(self.topic(name)) == []


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """A camera at a place in the map's own axes, turned to the right by so many radians."""
    pose = np.eye(4)
    pose[:3, :3] = geometry.so3_exp(np.array([0.0, yaw, 0.0]))
    pose[:3, 3] = x, y, z
    return pose


def keyframe(index: int, pose: np.ndarray, segment: int = 0) -> Keyframe:
    return Keyframe(
        index, 100.0 + index, np.zeros((24, 32, 3), np.uint8), np.array([25.0, 25, 15.5, 11.5]), pose, 1.0,
        np.zeros((3, 4), np.float32), np.zeros((3, 4), np.float32), segment,
    )  # fmt: skip


def seen(index: int, pose: np.ndarray, previous: np.ndarray | None, segment: int = 0) -> CameraPose:
    return CameraPose(index, 100.0 + index, pose, segment, previous)


def fused(index: int, depth: np.ndarray) -> FusedKeyframe:
    k = keyframe(index, np.eye(4))
    return FusedKeyframe(
        index, k.timestamp, k.image, k.intrinsics, k.world_from_cam, 1.0, depth, np.ones_like(depth),
        np.zeros((*depth.shape, 3), np.float32), 0,
    )  # fmt: skip


def preview(means: np.ndarray, opacities: np.ndarray, iterations: int = 1) -> Preview:
    n = len(means)
    image = np.zeros((4, 4, 3), np.uint8)
    colors = np.tile(np.array([[200, 100, 50]], np.uint8), (n, 1))
    return Preview(
        0, iterations, np.eye(4), np.ones(4), image, image, means.astype(np.float32),
        np.zeros((n, 3, 3), np.float32), colors, opacities.astype(np.float32), origin=np.array([0.0, 0.0, 10.0]),
    )  # fmt: skip


def matrix(transform: dict[str, Any]) -> np.ndarray:
    """Of a Pose or Transform message."""
    position, orientation = transform.get("position") or transform["translation"], transform.get("orientation")
    q = orientation or transform["rotation"]
    pose = np.eye(4)
    pose[:3, :3] = geometry.rotation_from_quaternion(np.array([q[a] for a in "wxyz"]))
    pose[:3, 3] = [position[a] for a in "xyz"]
    return pose


def send(messages: Iterator[Any]) -> None:
    assert list(messages) == []


def test_the_pose_is_in_the_axes_of_ros(peer: Peer) -> None:
    graph = Graph(peer)
    # a camera that went 3 ahead, 1 to its right, 2 down, and then turned to the right by 90 degrees
    send(graph.node.on_camera_pose(seen(0, at(x=1.0, y=2.0, z=3.0, yaw=np.pi / 2), None)))
    (message,) = graph.taken("pose")
    assert message["header"] == {"stamp": {"sec": 100, "nanosec": 0}, "frame_id": "map"}
    pose = matrix(message["pose"])
    assert pose[:3, 3] == pytest.approx([3.0, -1.0, -2.0])
    assert pose[:3, 0] == pytest.approx([0, -1, 0], abs=1e-9)  # it looks to the right: along -y
    assert pose[:3, 2] == pytest.approx([0, 0, 1], abs=1e-9)  # and stands upright
    (static,) = graph.taken("tf_static")
    (optical,) = static["transforms"]
    assert (optical["header"]["frame_id"], optical["child_frame_id"]) == ("camera", "camera_optical_frame")
    assert matrix(optical["transform"])[:3, 2] == pytest.approx([1, 0, 0])  # its z is ahead
    assert matrix(optical["transform"])[:3, 0] == pytest.approx([0, -1, 0])  # its x to the right


def test_a_map_of_poses_that_were_given_in_ros_stays_where_it_is(peer: Peer) -> None:
    graph = Graph(peer, axes="ros")
    upright = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # the axes of a camera that looks along x
    send(graph.node.on_camera_pose(seen(0, geometry.rigid(upright, np.array([3.0, -1.0, -2.0])), None)))
    (message,) = graph.taken("pose")
    np.testing.assert_allclose(matrix(message["pose"]), geometry.rigid(np.eye(3), np.array([3.0, -1, -2])), atol=1e-9)
    map_from_odom, odom_from_camera = chain(graph.taken("tf")[0])
    np.testing.assert_allclose(map_from_odom @ odom_from_camera, matrix(message["pose"]), atol=1e-9)
    send(graph.node.on_preview(preview(np.array([[1.0, 2.0, 3.0]]), np.ones(1))))
    (cloud,) = graph.taken("points")
    found = np.frombuffer(bytes(cloud["data"]), "<f4").reshape(-1, 4)
    np.testing.assert_allclose(found[0, :3], [1.0, 2.0, 13.0])


def chain(message: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    map_odom, odom_camera = message["transforms"]
    assert (map_odom["header"]["frame_id"], map_odom["child_frame_id"]) == ("map", "odom")
    assert (odom_camera["header"]["frame_id"], odom_camera["child_frame_id"]) == ("odom", "camera")
    return matrix(map_odom["transform"]), matrix(odom_camera["transform"])


def test_odometry_is_smooth_and_corrections_are_between_map_and_odom(peer: Peer) -> None:
    graph = Graph(peer, unit=2.0)
    send(graph.node.on_camera_pose(seen(0, at(), None)))
    send(graph.node.on_camera_pose(seen(1, at(z=1.0), at())))
    send(graph.node.on_camera_pose(seen(2, at(x=5.0, z=2.0), at(x=5.0, z=1.0))))  # a loop moved all by 5
    chains = [chain(message) for message in graph.taken("tf", 3)]
    assert [odom[0, 3] for _, odom in chains] == pytest.approx([0.0, 2.0, 4.0])
    assert [odom[1, 3] for _, odom in chains] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    assert chains[1][0] == pytest.approx(np.eye(4), abs=1e-9)
    assert chains[2][0][:3, 3] == pytest.approx([0.0, -10.0, 0.0])
    poses = [matrix(message["pose"]) for message in graph.taken("pose", 3)]
    for (map_odom, odom_camera), pose in zip(chains, poses, strict=True):
        assert map_odom @ odom_camera == pytest.approx(pose)


def test_odometry_stays_a_rotation_and_waits_where_the_motion_is_not_known() -> None:
    rng = np.random.default_rng(0)
    odometry, pose = Odometry(), np.eye(4)
    for _ in range(3000):
        after = pose @ geometry.se3_exp(0.02 * rng.normal(size=6))
        odom = odometry.follow(after, pose)
        pose = after
    assert odom[:3, :3] @ odom[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert odometry.map_from_odom @ odom == pytest.approx(pose, abs=1e-9)
    found_again = at(x=9.0)
    still = odometry.follow(found_again, None)
    assert still == pytest.approx(odom)
    assert odometry.map_from_odom @ still == pytest.approx(found_again)
    assert odometry.map_from_odom @ odometry.place(at(y=1.0)) == pytest.approx(at(y=1.0))


def test_the_path_is_of_keyframes_as_they_are_corrected(peer: Peer) -> None:
    graph = Graph(peer)
    for index in range(3):
        send(graph.node.on_keyframe(keyframe(index, at(z=float(index)))))
    assert [len(message["poses"]) for message in graph.taken("path", 3)] == [1, 2, 3]
    moved = np.stack([at(x=1.0, z=2.0 * i) for i in range(3)])
    send(graph.node.on_poses(Poses(1, np.arange(3), moved, np.full(3, 2.0))))
    send(graph.node.on_keyframe(keyframe(3, at(x=1.0, z=6.0))))
    (path,) = graph.taken("path")
    assert path["header"]["frame_id"] == "map"
    assert [matrix(p["pose"])[:2, 3].tolist() for p in path["poses"]] == [[2.0 * i, -1.0] for i in range(4)]
    assert [p["header"]["stamp"]["sec"] for p in path["poses"]] == [100, 101, 102, 103]


def test_a_tracker_that_sends_keyframes_alone_gives_poses_and_transforms_by_them(peer: Peer) -> None:
    graph = Graph(peer)
    send(graph.node.on_keyframe(keyframe(0, at())))
    send(graph.node.on_poses(Poses(1, np.array([0]), at(x=5.0)[None], np.ones(1))))
    send(graph.node.on_keyframe(keyframe(1, at(x=5.0, z=1.0))))
    map_odom, odom_camera = [chain(message) for message in graph.taken("tf", 2)][1]
    assert odom_camera[:3, 3] == pytest.approx([1.0, 0.0, 0.0])
    assert map_odom[:3, 3] == pytest.approx([0.0, -5.0, 0.0])
    assert len(graph.taken("pose", 2)) == 2


def test_first_keyframes_get_their_transforms_without_a_step_back_of_the_pose(peer: Peer) -> None:
    graph = Graph(peer)
    send(graph.node.on_camera_pose(seen(8, at(z=8.0), None)))
    for index in (0, 4, 8):
        send(graph.node.on_keyframe(keyframe(index, at(z=float(index)))))
    stamps = [message["transforms"][1]["header"]["stamp"]["sec"] for message in graph.taken("tf", 3)]
    assert stamps == [108, 100, 104]
    assert [message["header"]["stamp"]["sec"] for message in graph.taken("pose")] == [108]
    graph.none("pose")


def test_parts_without_a_common_frame_have_maps_of_their_own_until_they_are_joined(peer: Peer) -> None:
    graph = Graph(peer)
    send(graph.node.on_keyframe(keyframe(0, at())))
    send(graph.node.on_keyframe(keyframe(9, at(), segment=1)))
    assert [(m["header"]["frame_id"], len(m["poses"])) for m in graph.taken("path", 2)] == [("map", 1), ("map_1", 1)]
    joined = Poses(1, np.array([9]), at(x=1.0)[None], np.ones(1), segment=np.array([0], np.int32))
    send(graph.node.on_poses(joined))
    send(graph.node.on_keyframe(keyframe(10, at())))
    (path,) = graph.taken("path")
    assert (path["header"]["frame_id"], len(path["poses"])) == ("map", 3)


def test_stamps_are_of_the_senders_clock_where_it_is_known(peer: Peer) -> None:
    graph = Graph(peer)
    stamp, told = 1_790_000_000_123_456_789, {"sec": 1_790_000_000, "nanosec": 123_456_789}
    send(graph.node.on_camera_pose(replace(seen(0, at(), None), stamp=stamp)))
    send(graph.node.on_keyframe(replace(keyframe(0, at()), stamp=stamp)))
    send(graph.node.on_fused_keyframe(replace(fused(0, np.ones((2, 3), np.float32)), stamp=stamp)))
    send(graph.node.on_preview(preview(np.ones((4, 3)), np.ones(4))))
    (transforms,) = graph.taken("tf")
    assert [transform["header"]["stamp"] for transform in transforms["transforms"]] == [told] * 2
    (path,) = graph.taken("path")
    assert path["poses"][0]["header"]["stamp"] == told
    for name in ("pose", "path", "depth/image", "depth/camera_info", "points"):
        (message,) = graph.taken(name) if name != "path" else (path,)
        assert message["header"]["stamp"] == told


def test_depth_is_in_meters_and_nan_where_it_is_not_known(peer: Peer) -> None:
    graph = Graph(peer, unit=10.0, frames=Frames(optical="left_optical"))
    depth = np.array([[0.0, 1.5], [2.0, 0.0], [0.25, 3.0]], np.float32)
    send(graph.node.on_keyframe(keyframe(0, at())))
    send(graph.node.on_poses(Poses(1, np.array([0]), at()[None], np.array([2.0]))))  # twice as large since
    send(graph.node.on_fused_keyframe(fused(0, depth)))
    (image,), (info,) = graph.taken("depth/image"), graph.taken("depth/camera_info")
    assert image["header"] == info["header"] == {"stamp": {"sec": 100, "nanosec": 0}, "frame_id": "left_optical"}
    assert (image["height"], image["width"], image["encoding"], image["step"]) == (3, 2, "32FC1", 8)
    shown = np.array(image["data"], np.uint8).view("<f4").reshape(3, 2)
    np.testing.assert_allclose(shown, np.where(depth > 0, 20.0 * depth, np.nan))
    assert (info["height"], info["width"]) == (3, 2)
    assert info["k"][0] == pytest.approx(25.0 * 2 / 32)
    assert info["p"][:3] == info["k"][:3]


def test_the_map_as_points_when_it_changes_and_for_late_readers(peer: Peer) -> None:
    graph = Graph(peer, max_points=50, unit=2.0)
    means = np.stack([np.arange(200.0), np.zeros(200), np.ones(200)], axis=1)
    opacities = np.where(np.arange(200) % 2, 0.9, 0.1)
    send(graph.node.on_preview(preview(means, opacities)))
    send(graph.node.on_preview(preview(means, opacities)))
    (cloud,) = graph.taken("points")
    graph.none("points")
    assert cloud["width"] == 50
    assert cloud["height"] == 1
    assert cloud["point_step"] == 16
    assert [(f["name"], f["offset"], f["datatype"], f["count"]) for f in cloud["fields"]] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("rgb", 12, 7, 1),
    ]  # fmt: skip
    points = np.array(cloud["data"], np.uint8).reshape(50, 16)
    xyz = points[:, :12].copy().view("<f4")
    assert xyz[:, 0] == pytest.approx(np.full(50, 22.0))  # 1 + 10 of the origin ahead, in units of 2
    assert xyz[:, 1] == pytest.approx(-2.0 * (1 + 4 * np.arange(50)))
    assert points[:, 12:].tolist() == [[50, 100, 200, 0]] * 50
    send(graph.node.on_preview(preview(means[:4], np.ones(4), iterations=2)))
    assert graph.taken("points")[0]["width"] == 4
    peer.subscribe(graph.topic("points"), TYPES["points"], transient_local=True, depth=1)
    assert graph.taken("points")[0]["width"] == 4


@pytest.mark.parametrize("asked", [Asked.RESET, Asked.LOAD_MAP])
def test_another_map_takes_the_points_away_and_odometry_goes_on(peer: Peer, asked: Asked) -> None:
    graph = Graph(peer)
    means, opacities = np.ones((4, 3)), np.ones(4)
    send(graph.node.on_camera_pose(seen(0, at(), None)))
    send(graph.node.on_camera_pose(seen(1, at(z=2.0), at())))
    send(graph.node.on_preview(preview(means, opacities)))
    assert graph.taken("points")[0]["width"] == 4  # before the next: of points a reader has the newest alone
    send(graph.node.on_request(Request(7, asked)))
    assert graph.taken("points")[0]["width"] == 0
    send(graph.node.on_preview(preview(means, opacities, iterations=2)))  # of the map before
    graph.none("points")
    send(graph.node.on_keyframe(keyframe(2, at(x=5.0))))  # its CameraPose did not come
    send(graph.node.on_camera_pose(seen(3, at(x=5.0, z=1.0), at(x=5.0))))
    chains = [chain(message) for message in graph.taken("tf", 4)]
    assert [odom[0, 3] for _, odom in chains] == pytest.approx([0.0, 2.0, 2.0, 3.0])
    assert chains[2][0][:2, 3] == pytest.approx([-2.0, -5.0])
    send(graph.node.on_reply(Reply(7, True, "")))
    send(graph.node.on_preview(preview(means, opacities, iterations=3)))
    assert graph.taken("points")[0]["width"] == 4
    send(graph.node.on_request(Request(7, asked)))  # once more, by a tracker that was started again
    graph.none("points")
    assert 2 in graph.node._keyframes
    send(graph.node.on_reply(Reply(8, True, "")))  # before the request itself came from the tracker
    send(graph.node.on_request(Request(8, asked)))
    assert graph.taken("points")[0]["width"] == 0
    send(graph.node.on_preview(preview(means, opacities)))
    assert graph.taken("points")[0]["width"] == 4


def test_topics_that_are_not_wanted_are_not_there(peer: Peer) -> None:
    from nodes.ros2_publisher import Topics

    node = Ros2Publisher(
        Ros2Publisher.Config(
            domain=OWN_DOMAIN, topics=Topics(pose="", path="", points="", depth="", tf="", tf_static="")
        )
    )
    send(node.on_camera_pose(seen(0, at(), None)))
    send(node.on_keyframe(keyframe(0, at())))
    send(node.on_fused_keyframe(fused(0, np.ones((2, 3), np.float32))))
    send(node.on_preview(preview(np.zeros((2, 3)), np.ones(2))))
    assert node.stats.counts == {}


def test_false_parameters_are_refused() -> None:
    for wrong in ({"unit": 0.0}, {"unit": float("nan")}, {"queue": 0}, {"frames": Frames(odom="map")}, {"domain": 999}):
        with pytest.raises(ValueError):
            Ros2Publisher.Config(**wrong)
    assert replace(Frames(), map="world").map == "world"
