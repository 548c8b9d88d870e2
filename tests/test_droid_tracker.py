"""The DROID node: its messages, with noise for weights; and what it says without weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import msgs
from msgs import (
    CameraPose,
    Frame,
    Keyframe,
    Poses,
    Request,
    TrackedFrame,
    TrackerPhase,
    TrackingState,
    Trajectory,
)
from nodes import handlers, outputs
from nodes.droid_tracker import DroidTracker
from tests.support.gpu import GPU
from tests.support.sequences import synthetic

COUNT = 9
# the least size that the networks take, so that noise costs little
TRIAL = DroidTracker.Config(weights="random", area=64 * 86, constants={"stride": 1, "warmup": 5}, device="cpu")


def run(config: DroidTracker.Config, count: int = COUNT) -> tuple[DroidTracker, list[msgs.Message], list[Frame]]:
    frames = [
        Frame(i.index, i.timestamp, i.image, i.intrinsics, stamp=1000 + i.index) for i in synthetic(frames=80)[:count]
    ]
    node = DroidTracker(config)
    return node, [m for frame in frames for m in node.on_frame(frame)] + list(node.on_end()), frames


def test_contract() -> None:
    assert handlers(DroidTracker).keys() == {Frame, Request}
    assert set(outputs(DroidTracker)) == {
        Keyframe, Poses, TrackedFrame, CameraPose, TrackerPhase, Trajectory, Request,
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", GPU])
def test_noise_gives_honest_finite_messages(device: str) -> None:
    node, sent, frames = run(replace(TRIAL, device=device))
    assert any("noise" in warning for warning in node.stats.warnings)
    keyframes = [m for m in sent if isinstance(m, Keyframe)]
    poses = [m for m in sent if isinstance(m, Poses)]
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    assert len(keyframes) >= 5
    published: set[int] = set()
    for message in sent[:-1]:
        if isinstance(message, Keyframe):
            assert message.image is frames[message.index].image
            assert message.stamp == frames[message.index].stamp
            assert message.scale == 1.0
            assert np.isfinite(message.world_from_cam).all()
            assert np.isfinite(message.inverse_depth).all()
            assert message.inverse_depth.dtype == message.inverse_depth_weight.dtype == np.float32
            assert message.inverse_depth.shape == message.inverse_depth_weight.shape == (8, 10)
            np.testing.assert_array_equal(message.inverse_depth > 0, message.inverse_depth_weight > 0)
            assert message.inverse_depth_weight.max() <= 1
            published.add(message.index)
        elif isinstance(message, Poses):
            assert set(message.index.tolist()) <= published
            assert np.isfinite(message.world_from_cam).all()
            assert np.all(message.scale > 0)
    assert [p.revision for p in poses] == list(range(1, len(poses) + 1))
    assert trajectory.index.tolist() == list(range(COUNT))
    assert trajectory.index[trajectory.keyframe].tolist() == [k.index for k in keyframes]
    np.testing.assert_array_equal(poses[-1].world_from_cam, trajectory.world_from_cam[trajectory.keyframe])
    assert np.isfinite(trajectory.world_from_cam).all()
    assert set(trajectory.state.tolist()) <= {TrackingState.TRACKED, TrackingState.DEGENERATE}
    assert node.stats.counts["keyframes"] == len(keyframes)


@pytest.mark.slow
def test_too_few_frames_are_not_started() -> None:
    node, sent, _ = run(TRIAL, count=3)
    (trajectory,) = sent
    assert isinstance(trajectory, Trajectory)
    assert np.isnan(trajectory.world_from_cam).all()
    assert set(trajectory.state.tolist()) == {TrackingState.NOT_INITIALIZED}
    assert any("never started" in warning for warning in node.stats.warnings)


def test_a_stream_of_nothing_ends_with_an_empty_trajectory() -> None:
    (trajectory,) = list(DroidTracker(TRIAL).on_end())
    assert isinstance(trajectory, Trajectory)
    assert len(trajectory.index) == 0


def test_missing_weights_are_said_before_anything_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"droid\.pth.*MVSGS_WEIGHTS"):
        DroidTracker()
    (tmp_path / "droid.pth").write_bytes(b"half a downl")
    with pytest.raises(ValueError, match="truncated"):
        DroidTracker()
    with pytest.raises(ValueError, match="demo, tum, replica"):
        DroidTracker(DroidTracker.Config(weights="random", preset="kitti"))  # type: ignore[arg-type]
