"""Poses that a robot sends with its frames: the map is made with them, or told where it lies among them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from launch.summary import summary
from msgs import Frame, GroundTruth, Keyframe, Message, Trajectory
from msgs.codec import NEWEST, encode
from mvsgs_core.given_frame import read_given_frame
from nodes.catching_up import PASSED_OVER
from nodes.posed_tracker import PosedTracker
from nodes.robot import Robot
from tests.support.evaluated_wall import ORIGIN, SCALE, N, feed, poses_along, wall_evaluator
from tests.support.live_programs import Program
from tests.support.ports import tcp_address
from tests.support.sequences import synthetic


def sent(count: int) -> tuple[list[Frame], list[GroundTruth]]:
    items = synthetic(frames=80)[:count]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in items]
    truths = [GroundTruth(i.index, i.timestamp, i.image, i.intrinsics, i.world_from_cam, None) for i in items]
    return frames, truths


def fed(node: PosedTracker, messages: list[Frame | GroundTruth]) -> list[Message]:
    found: list[Message] = []
    for message in messages:
        found += node.on_frame(message) if isinstance(message, Frame) else node.on_ground_truth(message)
    return found + list(node.on_end())


def tracked(messages: list[Message]) -> list[int]:
    (trajectory,) = (message for message in messages if isinstance(message, Trajectory))
    return trajectory.index.tolist()


@pytest.mark.slow
def test_a_robots_poses_are_those_of_the_map_to_the_bit() -> None:
    address = tcp_address()
    robot = Robot(Robot.Config(path=address, timeout=3.0))
    items = synthetic(frames=80)[:20]

    def frames() -> Iterator[bytes]:
        for i in items:
            frame = Frame(i.index, i.timestamp, i.image, i.intrinsics, world_from_cam=i.world_from_cam)
            yield bytes(encode(frame, i.index, delivery=NEWEST))

    program = Program(robot, frames())
    try:
        came = list(robot.run())
    finally:
        program.close()
    found = fed(PosedTracker(), [message for message in came if isinstance(message, Frame | GroundTruth)])
    keyframes = [message for message in found if isinstance(message, Keyframe)]
    assert len(keyframes) >= 3
    for keyframe in keyframes:
        np.testing.assert_array_equal(keyframe.world_from_cam, items[keyframe.index].world_from_cam)


def test_what_came_with_frames_that_were_overtaken_is_forgotten() -> None:
    """Of a live stream a slow tracker gets the newest frames, and what belongs to all."""
    frames, truths = sent(12)
    node = PosedTracker()
    messages = fed(node, [frames[0], *truths[:7], frames[6], *truths[7:], frames[9], frames[11]])
    assert tracked(messages) == [0, 6, 9, 11]
    assert not any("without ground truth" in text for text in node.stats.warnings)
    assert not node._given


def test_in_real_time_a_frame_behind_which_another_waits_is_passed_over() -> None:
    frames, truths = sent(4)
    behind: list[Frame | GroundTruth] = [frames[0], truths[0], frames[1], frames[2], *truths[1:3], frames[3], truths[3]]
    node = PosedTracker(PosedTracker.Config(realtime=True))
    assert tracked(fed(node, behind)) == [0, 2, 3]
    assert node.stats.skipped[PASSED_OVER] == 1
    assert tracked(fed(PosedTracker(), behind)) == [0, 1, 2, 3]


def test_a_file_says_where_a_map_lies_among_the_poses_that_came(tmp_path: Path) -> None:
    report = feed(wall_evaluator(tmp_path))
    found = read_given_frame(tmp_path / "given_frame.json")
    assert report["given_frame"]["scale"] == pytest.approx(1 / SCALE)
    assert "given poses: distance to the trajectory" in (tmp_path / "report.html").read_text()
    assert (found.poses, found.distance) == (len(poses_along()), pytest.approx(0.0, abs=1e-6))
    true = poses_along()[:, :3, 3] / SCALE
    np.testing.assert_allclose(found.similarity.apply(poses_along()[:, :3, 3] + ORIGIN), true, atol=1e-6)


def test_poses_of_something_else_tell_no_frame_and_it_is_said(tmp_path: Path) -> None:
    node = wall_evaluator(tmp_path)
    for pose in node.evaluation.truth.values():
        pose[:3, 3] = 0.0
    report = feed(node)
    assert report["given_frame"] is None
    assert not (tmp_path / "given_frame.json").exists()
    said = "the poses that came with the frames do not tell where the map lies: their positions coincide"
    assert said in report["warnings"]["evaluator"]


def test_a_run_ends_with_how_to_have_its_map_among_the_poses_unless_it_was_made_of_them(tmp_path: Path) -> None:
    report = feed(wall_evaluator(tmp_path))
    for distance, told in ((0.0056, True), (1e-14, False)):
        report["given_frame"]["distance"] = distance
        (tmp_path / "report.json").write_text(json.dumps(report))
        lines = [line for line in summary(tmp_path).splitlines() if "--frame given" in line]
        assert len(lines) == told
        assert all(f"{distance:.4g} from the trajectory (median of {N})" in line for line in lines)
