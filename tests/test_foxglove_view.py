"""What Foxglove is shown of single messages: in any order, of several parts, bounded."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from msgs import Frame, FusedKeyframe, Keyframe, Poses, SplatMap, TrackedFrame, Trajectory
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.export import foxglove_messages
from nodes.foxglove_view import READ
from nodes.recorder import Recorder
from tests.support.example_messages import example
from tests.support.foxglove_file import Shown, ns, shown
from tests.support.mapper_messages import view_message


def seen(*messages: Any, to: Path) -> dict[str, list[Shown]]:
    """What a recorder writes of messages that are only shown."""
    recorder = Recorder(Recorder.Config(str(to), only_shown=[kind.__name__ for kind in READ]))
    for message in messages:
        recorder.on_message(message)
    recorder.on_abort("stopped")  # finishes the file as well
    return shown(to)


def keyframe(index: int, scale: float = 1.0, segment: int = 0) -> Keyframe:
    view = view_message(index, 0.1 * index, scale, segment)
    weight = np.ones((3, 4), np.float32)
    return Keyframe(
        view.index, view.timestamp, view.image, view.intrinsics, view.world_from_cam, scale, weight, weight, segment
    )


def moved(shift: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = shift
    return pose


def tracked(index: int, of: int, scale: float) -> TrackedFrame:
    return TrackedFrame(index, 0.1 * index, np.zeros((24, 32, 3), np.uint8), np.ones(4), of, moved(0.1), scale)


def position(pose: Any) -> list[float]:
    return [pose.message.pose.position.x, pose.message.pose.position.y, pose.message.pose.position.z]


def test_a_frame_between_follows_its_corrected_keyframe_in_any_order(tmp_path: Path) -> None:
    poses = Poses(1, np.array([5]), moved(7.0)[None], np.array([2.0]))
    orders = {
        "as sent": [keyframe(5), poses, tracked(6, 5, 1.0)],
        "keyframe late": [poses, tracked(6, 5, 1.0), keyframe(5)],
        "frame first": [tracked(6, 5, 1.0), poses, keyframe(5)],
    }
    for name, messages in orders.items():
        topics = seen(*messages, to=tmp_path / f"{name}.mcap")
        (between,) = (pose for pose in topics["/camera/pose"] if pose.ns == ns(0.6))
        np.testing.assert_allclose(position(between), [7.2, 0, 0], atol=1e-12, err_msg=name)  # twice as far: its scale


def test_parts_that_share_no_frame_of_reference_have_their_own(tmp_path: Path) -> None:
    joined = Poses(1, np.array([5]), moved(7.0)[None], np.array([1.0]), segment=np.array([0], np.int32))
    track = Trajectory(
        np.arange(4), 0.1 * np.arange(4), np.stack([moved(0), moved(1), np.full((4, 4), np.nan), moved(3)]),
        np.ones(4, bool), np.zeros(4, np.uint8), np.array([0, 0, 1, 1], np.int32),
    )  # fmt: skip
    topics = seen(
        keyframe(5, segment=1), tracked(6, 5, 1.0), view_message(5, 0.5, segment=1), joined,
        tracked(7, 5, 1.0), track, to=tmp_path / "a.mcap",
    )  # fmt: skip
    parts = [transform.message.transforms[0] for transform in topics["/tf"]]
    assert [(part.parent_frame_id, part.child_frame_id) for part in parts] == [
        ("map_1", "camera_1"), ("map_1", "camera_1"), ("map", "camera"),
    ]  # fmt: skip
    assert topics["/keyframe/points"][0].message.frame_id == "map_1"
    assert topics["/keyframe/depth"][0].message.frame_id == "camera_1"
    assert [len(topics[name][0].message.poses) for name in ("/trajectory", "/trajectory_1")] == [2, 1]
    assert topics["/trajectory_1"][0].message.frame_id == "map_1"


def test_images_are_of_the_part_of_the_newest_keyframe(tmp_path: Path) -> None:
    image = np.zeros((24, 32, 3), np.uint8)
    frames = [Frame(i, 0.1 * i, image, np.ones(4)) for i in range(5)]
    joined = Poses(1, np.array([2]), moved(7.0)[None], np.array([1.0]), segment=np.array([0], np.int32))
    topics = seen(
        frames[0], keyframe(0), frames[1], frames[2], keyframe(2, segment=1), frames[3], joined, frames[4],
        to=tmp_path / "a.mcap",
    )  # fmt: skip
    of = ["camera", "camera", "camera", "camera_1", "camera"]
    assert [shown.message.frame_id for shown in topics["/camera/image"]] == of


def test_what_is_sent_is_bounded(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (1080, 1920, 3), np.uint8)
    base = view_message(3, 0.3)
    large = {"image": image, "intrinsics": np.array([1600.0, 1600.0, 959.5, 539.5])}
    fused = FusedKeyframe(**(vars(base) | large | {"depth": np.ones((540, 960), np.float32)}))
    first = Keyframe(**(vars(keyframe(3)) | large))
    splats: Any = example(SplatMap)
    count = foxglove_messages.MAX_MAP_POINTS + 1
    means, sh, opacity = (
        np.ones((count, 3), np.float32),
        np.ones((count, 1, 3), np.float32),
        np.zeros(count, np.float32),
    )
    many = SplatMap(**(vars(splats) | {"means": means, "sh": sh, "opacity_logits": opacity}))
    frame = Frame(3, 0.3, image, large["intrinsics"])
    topics = seen(frame, first, fused, many, to=tmp_path / "a.mcap")
    sent = cv2.imdecode(np.frombuffer(topics["/camera/image"][0].message.data, np.uint8), cv2.IMREAD_COLOR)
    size = (sent.shape[0], sent.shape[1])
    assert 0.98 < sent.shape[0] * sent.shape[1] / (640 * 480) < 1.01
    fx, _, cx, _, fy, cy, *_ = topics["/camera/calibration"][0].message.K
    np.testing.assert_allclose([fx, fy, cx, cy], scale_intrinsics(large["intrinsics"], (1080, 1920), size))
    for topic, most in (("/keyframe/points", 10_000), ("/map", 200_000)):
        cloud = topics[topic][0].message
        assert 0.4 * most < len(cloud.data) / cloud.point_stride <= most


def test_times_that_their_clock_does_not_hold_are_its_first_and_last(tmp_path: Path) -> None:
    image = np.zeros((24, 32, 3), np.uint8)
    frames = [Frame(i, time, image, np.ones(4)) for i, time in enumerate((-5.0, 1.5, 9e10))]
    topics = seen(*frames, to=tmp_path / "a.mcap")
    assert [image.ns for image in topics["/camera/image"]] == [0, 1_500_000_000, foxglove_messages.LATEST]
    assert all(a.ns <= b.ns for a, b in pairwise(topics["/camera/image"]))
