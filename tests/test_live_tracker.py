"""The tracker in real time: the pose comes before a keyframe's work, and frames between are posed as there is time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import msgs
from msgs import CameraPose, Frame, Keyframe, TrackedFrame, TrackerPhase, Trajectory
from nodes.tracker import Tracker
from tests.support.sequences import synthetic

SKIPPED = "frames between keyframes that there was no time to pose again"


def frames(count: int = 45) -> list[Frame]:
    return [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in synthetic(frames=80)[:count]]


def sent_by(node: Tracker, idle: int | None = None) -> Iterator[msgs.Message]:
    """idle: slices that there is time for after each frame; None: as many as there are."""
    for frame in frames():
        yield from node.on_frame(frame)
        slices = 0
        while (idle is None or slices < idle) and (found := node.on_idle()) is not None:
            yield from found
            slices += 1
    yield from node.on_end()


def split(sent: list[msgs.Message]) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], Trajectory]:
    """Poses of keyframes and of frames between, by index, and the trajectory."""
    keyframes = {m.index: m.world_from_cam for m in sent if isinstance(m, Keyframe)}
    between = {m.index: m.keyframe_from_cam for m in sent if isinstance(m, TrackedFrame)}
    (trajectory,) = (m for m in sent if isinstance(m, Trajectory))
    return keyframes, between, trajectory


@pytest.mark.slow
def test_with_time_for_it_all_comes_out_as_without_hurry() -> None:
    unhurried = split(list(sent_by(Tracker())))
    node = Tracker(Tracker.Config(realtime=True))
    live = split(list(sent_by(node)))
    for one, other in zip(unhurried[:2], live[:2], strict=True):
        assert one.keys() == other.keys()
        for index in one:
            np.testing.assert_array_equal(one[index], other[index])
    np.testing.assert_array_equal(unhurried[2].world_from_cam, live[2].world_from_cam)
    assert SKIPPED not in node.stats.skipped


@pytest.mark.slow
def test_without_time_the_frames_between_stay_where_they_were_seen_first_and_none_is_lost() -> None:
    unhurried, node = split(list(sent_by(Tracker()))), Tracker(Tracker.Config(realtime=True))
    live = split(list(sent_by(node, idle=0)))
    assert unhurried[0].keys() == live[0].keys()
    for index, pose in unhurried[0].items():
        np.testing.assert_array_equal(pose, live[0][index])
    assert unhurried[1].keys() == live[1].keys()
    assert node.stats.skipped[SKIPPED] > 0
    off = [np.abs(pose - live[1][index]).max() for index, pose in unhurried[1].items()]
    assert 0.0 < max(off) < 0.02


@pytest.mark.slow
def test_the_pose_of_a_keyframe_goes_out_before_the_work_on_it() -> None:
    node, seen = Tracker(Tracker.Config(realtime=True)), 0
    for frame in frames():
        before = node.core.stats.counts.get("keyframes", 0)
        sent = node.on_frame(replace(frame, captured=time.time()))
        first = next(sent, None)
        if isinstance(first, CameraPose):
            begun = node.core.stats.counts.get("keyframes", 0)
            rest = list(sent)
            if any(isinstance(m, Keyframe) for m in rest) and before > 0:
                assert begun == before
                seen += 1
        else:
            rest = list(sent)
    assert seen > 2
    found = node.stats.values["latency"]["frame to pose"]
    assert found["count"] > 10
    assert 0.0 < found["median"] <= found["p99"] < 60.0


@pytest.mark.slow
def test_a_live_tracker_says_now_and_then_how_late_its_poses_are() -> None:
    node = Tracker(Tracker.Config(realtime=True))
    node_of_a_file = Tracker()
    live = [m for frame in frames() for m in node.on_frame(replace(frame, captured=time.time()))]
    recorded = [m for frame in frames() for m in node_of_a_file.on_frame(frame)]
    phases = [m for m in live if isinstance(m, TrackerPhase)]
    assert all(m.latency is not None for m in phases)
    assert phases[0].phase == "initializing"
    assert [m.phase for m in recorded if isinstance(m, TrackerPhase)] == ["tracking"]
    assert all(m.latency is None for m in recorded if isinstance(m, TrackerPhase))
