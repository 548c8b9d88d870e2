"""Where a camera was, from transforms as ROS publishes them: chains, times between, what is not known and what is
false."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.datasets.transform_tree import GAP, MOST, TransformTree

SECOND = 10**9


def transform(parent: str, child: str, seconds: float, pose: np.ndarray) -> SimpleNamespace:
    w, x, y, z = geometry.quaternion_from_rotation(pose[:3, :3]).tolist()
    position = dict(zip("xyz", pose[:3, 3].tolist()))
    stamp = SimpleNamespace(sec=int(seconds), nanosec=round(1e9 * (seconds % 1)))
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=stamp), child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(**position), rotation=SimpleNamespace(w=w, x=x, y=y, z=z)
        ),
    )  # fmt: skip


def message(*transforms: SimpleNamespace) -> Any:
    return SimpleNamespace(transforms=list(transforms))


def pose(*twist: float) -> np.ndarray:
    return geometry.se3_exp(np.array(twist, np.float64))


ODOM_FROM_BASE = [pose(0.1 * k, 0.02 * k, 0.0, 0.0, 0.0, 0.1 * k) for k in range(4)]  # at 10, 11, 12, 13 s
BASE_FROM_CAMERA = pose(0.2, 0.0, 0.5, -1.2, 1.2, -1.2)
MAP_FROM_ODOM = pose(5.0, -3.0, 0.0, 0.0, 0.0, 0.7)


@pytest.fixture
def robot() -> TransformTree:
    tree = TransformTree()
    tree.add(message(transform("base", "camera", 0.0, BASE_FROM_CAMERA)), static=True)
    for k in (0, 2, 1, 3):  # the network's order
        tree.add(message(transform("/odom", "/base", 10.0 + k, ODOM_FROM_BASE[k])), static=False)
    for seconds in (9.0, 10.5, 12.0):
        tree.add(message(transform("map", "odom", seconds, MAP_FROM_ODOM)), static=False)
    return tree


def test_a_camera_is_where_the_chain_of_transforms_has_it(robot: TransformTree) -> None:
    found = robot.pose("camera", "map", 11 * SECOND)
    np.testing.assert_allclose(np.asarray(found), MAP_FROM_ODOM @ ODOM_FROM_BASE[1] @ BASE_FROM_CAMERA, atol=1e-12)
    back = robot.pose("map", "camera", 11 * SECOND)
    np.testing.assert_allclose(np.asarray(back), geometry.inverse(np.asarray(found)), atol=1e-12)
    beside = robot.pose("camera", "base", 0)  # neither moves in the other
    np.testing.assert_allclose(np.asarray(beside), BASE_FROM_CAMERA, atol=1e-12)


def test_between_two_times_it_is_between_two_transforms(robot: TransformTree) -> None:
    found = robot.pose("camera", "odom", 11 * SECOND + SECOND // 4)
    between = geometry.interpolate(ODOM_FROM_BASE[1], ODOM_FROM_BASE[2], 0.25)
    np.testing.assert_allclose(np.asarray(found), between @ BASE_FROM_CAMERA, atol=1e-12)


def test_what_is_not_known_is_none_and_what_may_still_come_is_waited_for(robot: TransformTree) -> None:
    assert robot.pose("camera", "odom", 9 * SECOND) is None  # before the first
    assert not robot.waits("camera", "odom", 9 * SECOND)
    assert robot.pose("camera", "odom", 14 * SECOND) is None
    assert robot.waits("camera", "odom", 14 * SECOND)
    assert robot.pose("camera", "map", 12 * SECOND + 1) is None  # the map's is older than the odometry
    assert robot.waits("camera", "map", 12 * SECOND + 1)
    assert robot.pose("camera", "world", 11 * SECOND) is None
    assert not robot.connects("camera", "world")
    assert robot.waits("camera", "world", 11 * SECOND)
    robot.add(message(transform("odom", "base", 13.0 + GAP / SECOND + 1.0, ODOM_FROM_BASE[3])), static=False)
    assert robot.pose("camera", "odom", 14 * SECOND) is None  # nobody knows what was in so long a gap
    assert not robot.waits("camera", "odom", 14 * SECOND)


def test_what_is_no_transform_is_left_out_and_a_circle_ends() -> None:
    tree = TransformTree()
    wrong = [transform("a", "b", 1.0, pose(0, 0, 0, 0, 0, 0)) for _ in range(3)]
    wrong[0].transform.rotation.w = float("nan")
    wrong[1].transform.rotation.w = 3.0
    wrong[2].transform.translation.x = 1e200
    tree.add(message(*wrong, transform("a", "a", 1.0, np.eye(4)), transform("", "b", 1.0, np.eye(4))), static=False)
    assert (tree.refused, tree.frames) == (5, [])
    tree.add(message(transform("a", "b", 1.0, np.eye(4)), transform("b", "a", 1.0, np.eye(4))), static=False)
    assert tree.pose("a", "c", SECOND) is None
    tree.add(message(*(transform("r", f"f{k}", 1.0, np.eye(4)) for k in range(2 * MOST))), static=False)
    assert len(tree.frames) <= MOST + 1


def test_of_a_live_stream_old_transforms_are_forgotten() -> None:
    tree = TransformTree(keep=5 * SECOND)
    for k in range(100):
        tree.add(message(transform("odom", "camera", 10.0 + k, np.eye(4))), static=False)
    assert tree.pose("camera", "odom", 108 * SECOND) is not None
    assert tree.pose("camera", "odom", 20 * SECOND) is None
    assert len(tree._links["camera"].times) <= 6
