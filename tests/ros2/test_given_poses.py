"""dataset=ros2 with fixed_frame: images come with the poses that /tf has of their camera."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import pytest

from msgs import Frame, GroundTruth
from mvsgs_core import geometry
from nodes.ros2_camera import Ros2Camera
from tests.support.patience import LONG, until
from tests.support.ros2_images import CALIBRATION, IMAGE, INFO, config, picture, stamp
from tests.support.ros2_peer import Peer

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow

TF = "tf2_msgs/msg/TFMessage"
BASE_FROM_CAMERA = geometry.rigid(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, 0.0, 0.5]))
_numbers = count()


def odom_from_base(seconds: float) -> np.ndarray:
    return geometry.se3_exp(np.array([0.3 * seconds, 0.0, 0.0, 0.0, 0.0, 0.1 * seconds]))


def transform(parent: str, child: str, seconds: float, pose: np.ndarray) -> dict[str, Any]:
    w, x, y, z = geometry.quaternion_from_rotation(pose[:3, :3]).tolist()
    header = stamp(seconds)
    return {
        "header": {**header, "frame_id": parent}, "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", pose[:3, 3].tolist())), "rotation": {"x": x, "y": y, "z": z, "w": w}
        },
    }  # fmt: skip


class Robot:
    """Ten images a second of its time; what it says of the time before and after each comes behind it."""

    def __init__(self, peer: Peer, camera: str, node: Ros2Camera) -> None:
        self.peer, self.camera, self.node = peer, camera, node
        peer.advertise(f"{camera}/image_raw", IMAGE)
        peer.advertise(f"{camera}/camera_info", CALIBRATION)
        peer.advertise("/tf", TF, reliable=True)
        peer.advertise("/tf_static", TF, reliable=True, transient_local=True)
        peer.publish("/tf_static", {"transforms": [transform("base", "lens", 0.0, BASE_FROM_CAMERA)]})

    def send(self, images: int, told: int) -> None:
        asked = ("/tf", "/tf_static") if self.node.config.fixed_frame else ()
        for topic in (f"{self.camera}/image_raw", f"{self.camera}/camera_info", *asked):
            self.peer.wait_for_reader(topic)
        until(lambda: hasattr(self.node, "_infos") and self.node._images.writers and self.node._infos.writers)
        for k in range(images):
            seconds = 1000.0 + k / 10
            message = picture(k)
            message["header"] = {**stamp(seconds), "frame_id": "lens"}
            self.peer.publish(f"{self.camera}/camera_info", {"header": stamp(0.0), **INFO})
            self.peer.publish(f"{self.camera}/image_raw", message)
            if k < told:
                around = [transform("odom", "base", at, odom_from_base(at)) for at in (seconds - 0.04, seconds + 0.04)]
                self.peer.publish("/tf", {"transforms": around})
            until(partial(self._has_sent, k + 1))

    def _has_sent(self, frames: int) -> bool:
        return self.node.stats.counts.get("frames", 0) == frames


def received(peer: Peer, images: int, told: int, **other: Any) -> tuple[list[np.ndarray | None], Ros2Camera]:
    """The poses that came with the frames."""
    camera = f"/posed_{next(_numbers)}"
    node = Ros2Camera(config(camera, stop=images, timeout=LONG, **other))
    robot = Robot(peer, camera, node)
    thread = threading.Thread(target=robot.send, args=(images, told), daemon=True)
    thread.start()
    sent: Iterator[Frame | GroundTruth] = node.run()
    poses = [message.world_from_cam for message in sent if isinstance(message, GroundTruth)]
    thread.join()
    return poses, node


def test_images_wait_for_the_transforms_of_their_time(peer: Peer) -> None:
    poses, node = received(peer, images=8, told=6, fixed_frame="odom")
    for k, pose in enumerate(poses[:6]):
        assert pose is not None
        np.testing.assert_allclose(pose, odom_from_base(1000.0 + k / 10) @ BASE_FROM_CAMERA, atol=1e-4)
    assert poses[6:] == [None, None]
    assert node.stats.skipped["images without a pose in /tf"] == 2
    assert any("/tf did not say, within 0.5 s, where lens was in odom" in text for text in node.stats.warnings)


def test_a_frame_that_tf_does_not_have_is_named_and_nothing_is_asked_of_it_otherwise(peer: Peer) -> None:
    poses, node = received(peer, images=2, told=2, fixed_frame="map", camera_frame="base")
    assert poses == [None, None]
    said = "/tf does not connect 'base', the camera's frame, with 'map'; it has base, lens, odom: choose"
    assert any(said in text for text in node.stats.warnings)
    poses, node = received(peer, images=2, told=2)
    assert poses == [None, None]
    assert not any("/tf" in text for text in node.stats.warnings)
