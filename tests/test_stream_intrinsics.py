"""Intrinsics that a robot or a data set brings: one camera's, of its images' size, from the program to the map."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs import End, Frame, Keyframe, TrackedFrame
from msgs.codec import NEWEST, encode
from mvsgs_core.camera import scale_intrinsics
from nodes.robot import Robot
from nodes.tracker import Tracker
from tests.support.live_programs import received
from tests.support.ports import tcp_address
from tests.support.sequences import synthetic
from tests.support.shared_data import ROOT


@pytest.mark.slow
def test_intrinsics_that_change_are_sent_as_the_poses_are_found_with() -> None:
    """Those of the first frame, in the pixels of an image that is larger."""
    items, node = synthetic(frames=80)[:45], Tracker()
    first, size = items[0].intrinsics, (items[0].image.shape[0], items[0].image.shape[1])
    sent = []
    for item in items:
        frame = Frame(item.index, item.timestamp, item.image, (1.0 if item.index < 20 else 1.5) * first)
        if item.index >= 30:
            frame = replace(frame, image=np.repeat(np.repeat(item.image, 2, axis=0), 2, axis=1))
        sent += list(node.on_frame(frame))
    sent += list(node.on_end())
    assert "the intrinsics change between frames: the tracker goes on with those of the first" in node.stats.warnings
    for kind in (Keyframe, TrackedFrame):
        of_kind = [message for message in sent if isinstance(message, kind)]
        assert max(message.index for message in of_kind) >= 35
        for message in of_kind:
            ours = scale_intrinsics(first, size, (message.image.shape[0], message.image.shape[1]))
            np.testing.assert_allclose(message.intrinsics, ours, rtol=1e-9)
            assert message.index >= 20 or np.array_equal(message.intrinsics, first)  # as they came, to the bit


@pytest.mark.slow
def test_intrinsics_of_images_of_another_size_are_doubted_once() -> None:
    def frames() -> Iterator[bytes]:
        for i in range(5):
            image, intrinsics = np.full((24, 32, 3), i, np.uint8), np.array([50.0, 50.0, 31.5, 23.5])
            yield bytes(encode(Frame(i, i / 10, image, intrinsics), i, delivery=NEWEST))
        yield bytes(encode(End(), 5, delivery=NEWEST))

    robot = Robot(Robot.Config(path=tcp_address(), timeout=20.0))
    assert len(received(robot, frames())) == 5
    (doubt,) = [line for line in robot.stats.warnings if "principal point" in line]
    assert "the robot's frames: " in doubt
    assert "another size (about 64x48)" in doubt


def test_the_robot_in_examples_sends_the_intrinsics_of_the_command_line_or_refuses_them(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((48, 64, 3), 8 * k, dtype=np.uint8))
    program, given = runpy.run_path(str(ROOT / "examples/robot.py")), ("50", "50", "31.5", "23.5")
    sent = list(program["opened"](program["parse"](["--dataset", "images", str(tmp_path), "--intrinsics", *given])))
    assert [frame.intrinsics.tolist() for frame in sent] == 3 * [[float(v) for v in given]]
    with pytest.raises(ValueError, match="no option"):
        program["opened"](program["parse"](["--dataset", "synthetic", "room", "--intrinsics", *given]))
