"""The tracker nodes and the rolling shutter: what goes out of a camera whose rows are read one after another."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np
import pytest

import msgs
from msgs import Frame, GroundTruth, Keyframe, Poses, TrackedFrame, Trajectory
from mvsgs_core import geometry
from mvsgs_core.datasets.synthetic import FPS, Synthetic
from mvsgs_core.image_metrics import psnr
from mvsgs_core.tracking.estimation import calibration
from mvsgs_core.tracking.estimation.rolling_shutter import Readout
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes.posed_tracker import PosedTracker
from nodes.tracker import Tracker, in_milliseconds


def of_type(sent: list[msgs.Message], kind: type) -> list:  # type: ignore[type-arg]
    return [message for message in sent if isinstance(message, kind)]


def rolling_messages(count: int, kind: str = "rolling_shutter") -> tuple[list[Frame], list[GroundTruth]]:
    rolling = Synthetic(threads=1, **{kind: 0.5})
    items = [rolling[n] for n in range(count)]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics, stamp=1000 + i.index) for i in items]
    return frames, [GroundTruth(i.index, i.timestamp, i.image, i.intrinsics, i.world_from_cam, None) for i in items]


def check_global_shutter(keyframes: list[Keyframe], frames: list[Frame]) -> None:
    still, gains = Synthetic(threads=1), []
    assert len(keyframes) > 5
    for keyframe in keyframes[1:]:  # before the first one nothing has moved
        images = still[keyframe.index].image, keyframe.image, frames[keyframe.index].image
        truth, ours, seen = (image[8:-8, 8:-8].astype(np.float32) / 255 for image in images)
        gains.append(psnr(ours, truth) - psnr(seen, truth))
    assert np.mean(gains) > 3.0, gains
    assert min(gains) > 0.0, gains


def check_photographs(keyframes: list[Keyframe], frames: list[Frame]) -> None:
    """What the map is made of: the frames as they came, and a velocity that turns the camera as its poses do."""
    still, off = Synthetic(threads=1), []
    for keyframe in keyframes[1:]:
        assert keyframe.photograph is frames[keyframe.index].image
        assert keyframe.readout_time == 0.5 / FPS
        assert keyframe.velocity is not None
        before, now = still[keyframe.index - 1].world_from_cam, still[keyframe.index].world_from_cam
        turn = geometry.se3_log(geometry.inverse(before) @ now)[3:] * FPS
        off.append(np.linalg.norm(keyframe.velocity[3:] - turn) / np.linalg.norm(turn))
    assert np.median(off) < 0.3, off


def check_frames_between(between: list[TrackedFrame], frames: list[Frame], trajectory: Trajectory) -> None:
    """As they came, with the velocity between the frames beside them, which later corrections hardly change."""
    assert len(between) > 5
    final = CameraTrajectory(**vars(trajectory)).velocities_of(np.array([b.index for b in between]))
    for b, velocity in zip(between, final, strict=True):
        assert b.image is frames[b.index].image
        assert b.readout_time == 0.5 / FPS
        assert b.velocity is not None
        assert np.linalg.norm(b.velocity - velocity) < 0.1 * np.linalg.norm(velocity)


@pytest.mark.slow
@pytest.mark.parametrize("rectify_rolling_shutter", [True, False])
def test_keyframes_are_as_a_global_shutter_would_have_taken_them(rectify_rolling_shutter: bool) -> None:
    frames, _ = rolling_messages(30)
    node = Tracker(Tracker.Config(readout_time=0.5 / FPS, rectify_rolling_shutter=rectify_rolling_shutter))
    sent = [m for frame in frames for m in node.on_frame(frame)] + list(node.on_end())
    (trajectory,) = of_type(sent, Trajectory)
    keyframes = of_type(sent, Keyframe)
    if rectify_rolling_shutter:
        assert trajectory.readout_time == 0.5 / FPS
        check_global_shutter(keyframes, frames)
        check_photographs(keyframes, frames)
        check_frames_between(of_type(sent, TrackedFrame), frames, trajectory)
        final = of_type(sent, Poses)[-1]
        assert final.readout_time == 0.5 / FPS
        assert final.velocity is not None
        assert final.index.tolist() == [k.index for k in keyframes]
        for row, keyframe in zip(final.velocity, keyframes, strict=True):
            seen = dict(zip(trajectory.index.tolist(), trajectory.world_from_cam, strict=True))
            around = [n for n in (keyframe.index - 1, keyframe.index + 1) if n in seen and np.isfinite(seen[n]).all()]
            if len(around) == 2:
                moved = geometry.se3_log(geometry.inverse(seen[around[0]]) @ seen[around[1]])
                np.testing.assert_allclose(row, moved * FPS / 2, rtol=1e-6, atol=1e-9)
    else:
        assert trajectory.readout_time == 0.0
        assert all(k.image is frames[k.index].image and k.photograph is None for k in keyframes)
        assert all(b.velocity is None and b.readout_time == 0.0 for b in of_type(sent, TrackedFrame))
        assert all(p.velocity is None and p.readout_time == 0.0 for p in of_type(sent, Poses))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Tracker, PosedTracker])
def test_so_are_those_of_a_camera_that_reads_columns(kind: type[Tracker] | type[PosedTracker]) -> None:
    frames, truths = rolling_messages(30, "rolling_columns")
    node = kind(kind.Config(readout_time=0.5 / FPS, reads_columns=True))  # type: ignore[arg-type]
    sent: list[msgs.Message] = []
    for frame, truth in zip(frames, truths, strict=True):
        sent += node.on_frame(frame)
        sent += node.on_ground_truth(truth) if isinstance(node, PosedTracker) else []
    sent += node.on_end()
    keyframes = of_type(sent, Keyframe)
    check_global_shutter(keyframes, frames)
    check_photographs(keyframes, frames)
    assert all(k.reads_columns for k in keyframes)
    assert all(k.stamp == frames[k.index].stamp for k in keyframes)
    assert all(b.reads_columns for b in of_type(sent, TrackedFrame))
    assert all(t.reads_columns and t.readout_time == 0.5 / FPS for t in of_type(sent, Trajectory))
    if kind is Tracker:
        assert of_type(sent, Poses)[-1].reads_columns


def test_columns_are_read_within_a_time_that_is_given() -> None:
    with pytest.raises(ValueError, match=r"tracker\.reads_columns=true: give tracker\.readout_time"):
        Tracker(Tracker.Config(reads_columns=True))


@pytest.mark.slow
def test_keyframes_sent_before_the_readout_time_was_known_get_it_with_their_next_correction() -> None:
    """As the tracker finds it: 0 where the first keyframes do not tell it, and later what they do."""
    frames, _ = rolling_messages(40)
    node = Tracker(Tracker.Config(readout_time=0.0))
    early: list[msgs.Message] = []
    for n, frame in enumerate(frames):
        if n == 25:
            node.core.session.graph.readout_time = 0.5 / FPS
            break
        early += node.on_frame(frame)
    late = [m for frame in frames[25:] for m in node.on_frame(frame)]
    without = {k.index for k in of_type(early, Keyframe)}
    assert without
    assert all(k.photograph is None and k.velocity is None for k in of_type(early, Keyframe))
    assert all(p.velocity is None for p in of_type(early, Poses))
    told: dict[int, np.ndarray] = {}
    for poses in of_type(late, Poses):
        if poses.velocity is not None:
            assert poses.readout_time == 0.5 / FPS
            told |= {int(i): v for i, v in zip(poses.index, poses.velocity) if np.isfinite(v).all()}
    assert told
    assert set(told) <= without
    final = of_type(list(node.on_end()), Poses)[-1]
    assert final.velocity is not None
    known = dict(zip(final.index.tolist(), final.velocity))
    off = [np.linalg.norm(v[3:] - known[i][3:]) / np.linalg.norm(known[i][3:]) for i, v in told.items()]
    assert np.median(off) < 0.3, off
    assert np.isfinite([known[i] for i in without]).all()


def test_a_readout_time_that_falls_to_zero_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are then those of a camera without a rolling shutter, and the map has to render like that."""
    found = [0.5 / FPS]

    def estimating(graph: object, indices: object, threads: int) -> Generator[None, None, Readout]:
        yield
        return Readout(found[-1], False)

    monkeypatch.setattr(calibration, "estimating_readout", estimating)
    frames, _ = rolling_messages(24)
    node = Tracker()
    early: list[msgs.Message] = [m for frame in frames for m in node.on_frame(frame)]
    assert max(k.readout_time for k in of_type(early, Keyframe)) == found[0]
    found.append(0.0)
    final = of_type(list(node.on_end()), Poses)[-1]
    assert node.core.readout_time == final.readout_time == 0.0
    assert final.velocity is not None
    assert np.isfinite(final.velocity).any()  # those on their way to the map take it by their velocity


@pytest.mark.slow
def test_keyframes_with_true_poses_are_as_a_global_shutter_would_have_taken_them() -> None:
    frames, truths = rolling_messages(30)
    node = PosedTracker(PosedTracker.Config(readout_time=0.5 / FPS))
    sent: list[msgs.Message] = []
    for frame, truth in zip(frames, truths, strict=True):
        sent += [*node.on_frame(frame), *node.on_ground_truth(truth)]
    sent += list(node.on_end())
    (trajectory,) = of_type(sent, Trajectory)
    assert trajectory.readout_time == 0.5 / FPS
    check_global_shutter(of_type(sent, Keyframe), frames)
    check_photographs(of_type(sent, Keyframe), frames)
    check_frames_between(of_type(sent, TrackedFrame), frames, trajectory)


@pytest.mark.parametrize("node", [Tracker, PosedTracker])
@pytest.mark.parametrize("readout_time", [25.0, -25.0, float("nan")])
def test_a_readout_in_another_unit_is_refused(node: type[Tracker] | type[PosedTracker], readout_time: float) -> None:
    with pytest.raises(ValueError, match=r"tracker\.readout_time=.*seconds.*at most 0\.2"):
        node(node.Config(readout_time=readout_time))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_keyframe_whose_shutter_stays_in_is_counted() -> None:
    frames, _ = rolling_messages(30)
    node = Tracker(Tracker.Config(readout_time=0.5 / FPS))
    slow = [replace(f, timestamp=10 * f.timestamp) for f in frames]  # too far apart to know a velocity
    keyframes = of_type([m for f in slow for m in node.on_frame(f)], Keyframe)
    assert len(keyframes) > 5
    assert all(k.image is frames[k.index].image for k in keyframes)
    assert node.stats.counts["keyframes with the rolling shutter still in: no velocity"] == len(keyframes)


def test_what_was_taken_out_of_the_keyframes_is_told() -> None:
    """The estimate of the readout time changes while keyframes go out: the report has what each was sent with."""
    frames, _ = rolling_messages(40)
    node = Tracker(Tracker.Config(readout_time=0.5 / FPS))
    for n, frame in enumerate(frames):
        if n == 30:  # as the tracker does when it knows better
            node.core.session.graph.readout_time = 0.4 / FPS
        list(node.on_frame(frame))
    list(node.on_end())
    early, late = 0.5 / FPS, 0.4 / FPS
    assert set(node._readout_times) == {early, late}
    published = node.stats.values["rolling shutter taken out of keyframes"]
    assert (
        published == f"{1e3 * np.mean(node._readout_times):.1f} ms in the mean, {1e3 * late:.1f} to {1e3 * early:.1f}"
    )
    assert in_milliseconds([0.02, 0.02]) == "20.0 ms"
