"""A bag's /tf gives its images their camera's poses, in ROS 1 and 2."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from mvsgs_core import geometry
from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.bag_poses import BagPoses
from mvsgs_core.datasets.ros import seconds_of
from mvsgs_core.datasets.sequence import Notices
from mvsgs_core.datasets.transform_tree import TransformTree
from tests.support.bag_messages import WIDTH, Messages, picture

TF = "tf2_msgs/msg/TFMessage"
ODOM_FROM_BASE = [geometry.se3_exp(np.array([0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.05 * k])) for k in range(6)]
BASE_FROM_CAMERA = geometry.rigid(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, 0.0, 0.5]))


@pytest.fixture(params=[1, 2])
def ros(request: pytest.FixtureRequest) -> Messages:
    found = Messages(request.param)
    if TF not in found.store.types:  # of ROS 1, where it is no core type
        found.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return found


def transforms(ros: Messages, *told: tuple[str, str, float, np.ndarray]) -> Any:
    """Of parent, child, seconds and pose (4, 4)."""
    t, found = ros.store.types, []
    for parent, child, seconds, pose in told:
        w, x, y, z = geometry.quaternion_from_rotation(pose[:3, :3]).tolist()
        header = ros.header(seconds)
        header.frame_id = parent
        moved = t["geometry_msgs/msg/Vector3"](*pose[:3, 3].tolist())
        transform = t["geometry_msgs/msg/Transform"](moved, t["geometry_msgs/msg/Quaternion"](x, y, z, w))
        found.append(t["geometry_msgs/msg/TransformStamped"](header, child, transform))
    return t[TF](found)


def bag(ros: Messages, path: Path, known: int = 6) -> Path:
    """Six images, 100 to 100.5 s; odometry 40 ms before and after each of the first `known`."""
    steady = ("base", "camera", 0.0, BASE_FROM_CAMERA)
    messages = [("/c/camera_info", 1.0, ros.info()), ("/tf_static", 1.0, transforms(ros, steady))]
    for k in range(known):
        for seconds in (99.96 + k / 10, 100.04 + k / 10):
            moved = ("odom", "base", seconds, ODOM_FROM_BASE[k])
            messages.append(("/tf", 2.0 + k, transforms(ros, moved)))
    images = [("/c/image_raw", 2.5 + k, ros.image(k, "rgb8", picture(k), 3 * WIDTH)) for k in range(6)]
    return ros.write(path, sorted([*messages, *images], key=lambda each: each[1]))


def test_images_have_the_poses_of_their_times_in_the_frame_that_was_asked_for(tmp_path: Path, ros: Messages) -> None:
    path = bag(ros, tmp_path / ("a.bag" if ros.ros == 1 else "a"), known=4)
    sequence = open_dataset("bag", path=str(path), fixed_frame="odom")
    items = list(sequence)
    for k, item in enumerate(items[:4]):
        assert item.world_from_cam is not None
        # images come at 100, 100.1, ...: between the transforms before and after, which are the same
        np.testing.assert_allclose(item.world_from_cam, ODOM_FROM_BASE[k] @ BASE_FROM_CAMERA, atol=1e-6)
    assert [item.world_from_cam for item in items[4:]] == [None, None]
    said = "images without a pose, as /tf does not say where camera was in odom then: 2 (first: 100.400 s)"
    assert said in sequence.warnings
    again = list(sequence)
    assert [item.world_from_cam is None for item in again] == [False] * 4 + [True] * 2
    assert sum("without a pose" in text for text in sequence.warnings) == 1


def test_another_camera_frame_can_be_named_and_none_is_asked_for_by_itself(tmp_path: Path, ros: Messages) -> None:
    path = bag(ros, tmp_path / ("a.bag" if ros.ros == 1 else "a"))
    (first, *_) = open_dataset("bag", path=str(path), fixed_frame="/odom", camera_frame="base")
    assert first.world_from_cam is not None
    np.testing.assert_allclose(first.world_from_cam, ODOM_FROM_BASE[0], atol=1e-9)
    assert all(item.world_from_cam is None for item in open_dataset("bag", path=str(path)))


def test_frames_that_are_not_there_are_named(tmp_path: Path, ros: Messages) -> None:
    path = bag(ros, tmp_path / ("a.bag" if ros.ros == 1 else "a"))
    with pytest.raises(ValueError, match=r"does not connect 'camera'.* with 'map'; it has base, camera, odom: choose"):
        open_dataset("bag", path=str(path), fixed_frame="map")
    bare = tmp_path / ("b.bag" if ros.ros == 1 else "b")
    ros.write(bare, [("/c/image_raw", 2.0, ros.image(0, "rgb8", picture(0), 3 * WIDTH))])
    with pytest.raises(ValueError, match=r"fixed_frame=odom: the bag has no /tf"):
        open_dataset("bag", path=str(bare), fixed_frame="odom")


def test_the_last_image_has_a_pose_of_its_own_time_after_which_no_transform_comes() -> None:
    """Stamps of images are held in seconds, whose steps are some hundred nanoseconds today."""
    still = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    tree, notices = TransformTree(), Notices()
    for nanoseconds in [0, *sorted(np.random.default_rng(0).integers(1, 10**9, 20).tolist())]:
        stamp = SimpleNamespace(sec=1_764_460_800, nanosec=nanoseconds)
        told = SimpleNamespace(
            header=SimpleNamespace(stamp=stamp, frame_id="odom"), child_frame_id="camera",
            transform=SimpleNamespace(translation=still, rotation=still),
        )  # fmt: skip
        tree.add(SimpleNamespace(transforms=[told]), static=False)
        if nanoseconds > 0:  # after a first one
            assert BagPoses(tree, "camera", "odom").at(seconds_of(told, 0), notices) is not None
    assert not notices
