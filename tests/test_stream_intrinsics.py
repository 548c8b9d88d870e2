"""Intrinsics that a robot or a data set brings: one camera's, of its images' size, from the program to the map."""

from __future__ import annotations

import runpy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs import End, Frame, Keyframe, TrackedFrame, Trajectory
from msgs.codec import NEWEST, encode
from mvsgs_core.camera import resampled, scale_intrinsics
from mvsgs_core.geometry import umeyama
from mvsgs_core.stats import Stats
from nodes.one_camera import OneCamera
from nodes.photographs_tracker import PhotographsTracker
from nodes.robot import Robot
from nodes.tracker import Tracker
from tests.support.live_programs import received
from tests.support.ports import tcp_address
from tests.support.sequences import synthetic
from tests.support.shared_data import ROOT


@pytest.mark.slow
def test_frames_whose_intrinsics_change_are_sent_as_one_camera_takes_them() -> None:
    """As the first frame's, in the pixels of an image that is larger."""
    items, node = synthetic(frames=80)[:45], Tracker()
    first, size = items[0].intrinsics, (items[0].image.shape[0], items[0].image.shape[1])
    sent = []
    for item in items:
        own = first if item.index < 20 else first * [0.95, 0.95, 1.0, 1.0] + [0.0, 0.0, 4.0, -3.0]
        image = resampled(item.image, first, own)
        if item.index >= 30:
            image = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)
        own = scale_intrinsics(own, size, (image.shape[0], image.shape[1]))
        sent += list(node.on_frame(Frame(item.index, item.timestamp, image, own)))
    sent += list(node.on_end())
    assert node.stats.counts["frames resampled to the intrinsics of the first"] == 25
    assert not any("intrinsics" in warning for warning in node.stats.warnings)
    for kind in (Keyframe, TrackedFrame):
        of_kind = [message for message in sent if isinstance(message, kind)]
        assert max(message.index for message in of_kind) >= 35
        for message in of_kind:
            ours = scale_intrinsics(first, size, (message.image.shape[0], message.image.shape[1]))
            np.testing.assert_allclose(message.intrinsics, ours, rtol=1e-9)
            assert message.index >= 20 or np.array_equal(message.intrinsics, first)  # as they came, to the bit
            shown, taken = cv2.resize(message.image, size[::-1], interpolation=cv2.INTER_AREA), items[message.index]
            assert np.abs(shown.astype(float) - taken.image).mean() < (0.1 if message.index < 20 else 4.0)
    (trajectory,) = (message for message in sent if isinstance(message, Trajectory))
    found, true = trajectory.world_from_cam[:, :3, 3], np.stack([item.world_from_cam[:3, 3] for item in items])
    alignment = umeyama(found, true)
    aligned = alignment.apply(found)
    assert np.linalg.norm(aligned - true, axis=1).max() < 0.01 * np.linalg.norm(np.diff(true, axis=0), axis=1).sum()


def test_what_a_frame_does_not_show_of_the_first_frames_view_is_masked() -> None:
    camera, stats = OneCamera(), Stats()
    image, first = np.full((48, 64, 3), 90, np.uint8), np.array([50.0, 50.0, 31.5, 23.5])
    frame = Frame(0, 0.0, image, first)
    assert camera.frame(frame, stats) is frame
    narrow = camera.frame(replace(frame, intrinsics=first * [2.0, 2.0, 1.0, 1.0]), stats)
    assert narrow.mask is not None
    rows, columns = np.nonzero(narrow.mask)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (12, 35, 16, 47)
    wide = camera.frame(replace(frame, intrinsics=first * [0.5, 0.5, 1.0, 1.0]), stats)
    assert wide.mask is None
    masked = camera.frame(replace(wide, intrinsics=frame.intrinsics * 0.5, mask=np.zeros((48, 64), bool)), stats)
    assert masked.mask is not None
    assert not masked.mask.any()
    rounded = replace(frame, intrinsics=first * 1.0005)
    assert camera.frame(rounded, stats) is rounded
    assert stats.counts["frames resampled to the intrinsics of the first"] == 3
    (said,) = stats.warnings
    assert "the focal length changes while the stream runs" in said


def test_photographs_keep_each_its_own_lens() -> None:
    node, image, first = PhotographsTracker(), np.zeros((48, 64, 3), np.uint8), np.array([50.0, 50.0, 31.5, 23.5])
    for index in range(2):
        frame = Frame(index, 0.0, image, first * [1.0 + index, 1.0 + index, 1.0, 1.0])
        list(node.on_frame(frame))
        assert node._frames[index] is frame


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


def test_the_robot_in_examples_sends_masks_and_the_intrinsics_of_the_command_line(tmp_path: Path) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((48, 64, 3), 8 * k, dtype=np.uint8))
    program, given = runpy.run_path(str(ROOT / "examples/robot.py")), ("50", "50", "31.5", "23.5")
    sent = list(program["opened"](program["parse"](["--dataset", "images", str(tmp_path), "--intrinsics", *given])))
    assert [frame.intrinsics.tolist() for frame in sent] == 3 * [[float(v) for v in given]]
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks/1.png"), np.repeat(np.uint8([9, 0]), [40, 8])[:, None].repeat(64, 1))
    masks = [frame.mask for frame in program["opened"](program["parse"](["--dataset", "images", str(tmp_path)]))]
    assert [mask is None for mask in masks] == [True, False, True]
    assert masks[1][:40].all()
    assert not masks[1][40:].any()
    with pytest.raises(ValueError, match="no option"):
        program["opened"](program["parse"](["--dataset", "synthetic", "room", "--intrinsics", *given]))
