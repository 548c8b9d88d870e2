"""CameraPose: where the tracker sees the camera, with each frame as it comes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from msgs import CameraPose, Frame, Keyframe
from mvsgs_core import geometry
from nodes.tracker import Tracker
from tests.support.sequences import synthetic


@pytest.mark.slow
def test_the_cameras_pose_comes_with_each_frame() -> None:
    items = synthetic(frames=80)[:45]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics, stamp=1000 + i.index) for i in items]
    node = Tracker()
    poses: dict[int, CameraPose] = {}
    for frame in frames:
        sent = list(node.on_frame(frame))
        found = [message for message in sent if isinstance(message, CameraPose)]
        assert len(found) <= 1
        assert all(m.stamp == frames[m.index].stamp for m in sent if isinstance(m, Keyframe))
        poses |= {pose.index: pose for pose in found}
    trajectory = list(node.on_end())[-1]
    tracked = [int(i) for i in trajectory.index if i in poses]
    assert len(tracked) >= len(frames) - min(poses)  # each, from the first on
    scale = np.linalg.norm(trajectory.world_from_cam[-1, :3, 3] - trajectory.world_from_cam[0, :3, 3])
    for index in tracked:
        final = trajectory.world_from_cam[index]
        assert np.linalg.norm(poses[index].world_from_cam[:3, 3] - final[:3, 3]) < 0.05 * scale
        assert poses[index].segment == trajectory.segment[index]
        assert poses[index].timestamp == frames[index].timestamp
        assert poses[index].stamp == frames[index].stamp
    true = [item.world_from_cam for item in items]
    for before, index in itertools.pairwise(tracked):
        previous = poses[index].world_from_previous
        if previous is None:
            assert index == tracked[0]
            continue
        motion, truth = (
            geometry.inverse(a) @ b for a, b in ((previous, poses[index].world_from_cam), (true[before], true[index]))
        )
        assert np.linalg.norm(geometry.so3_log(geometry.inverse(motion)[:3, :3] @ truth[:3, :3])) < 0.01
    node.unread = frozenset({CameraPose})
    assert not [message for message in node.on_frame(frames[-1]) if isinstance(message, CameraPose)]
