"""The tracker nodes: messages in, messages out."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

import msgs
from msgs import CameraPose, Frame, GroundTruth, Keyframe, Poses, TrackedFrame, TrackerPhase, TrackingState, Trajectory
from mvsgs_core import geometry
from mvsgs_core.datasets.synthetic import FPS, Synthetic
from mvsgs_core.held_out import is_held_out
from mvsgs_core.image_metrics import psnr
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes import Node, handlers, outputs
from nodes.posed_tracker import PosedTracker
from nodes.tracker import Tracker, in_milliseconds
from tests.support.sequences import synthetic


def messages(count: int = 45) -> tuple[list[Frame], list[GroundTruth]]:
    items = synthetic(frames=80)[:count]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in items]
    truths = [GroundTruth(i.index, i.timestamp, i.image, i.intrinsics, i.world_from_cam, i.depth) for i in items]
    return frames, truths


def of_type(sent: list[msgs.Message], kind: type) -> list:  # type: ignore[type-arg]
    return [message for message in sent if isinstance(message, kind)]


def test_contracts() -> None:
    assert handlers(Tracker).keys() == {Frame}
    assert set(outputs(Tracker)) == {Keyframe, Poses, TrackedFrame, CameraPose, TrackerPhase, Trajectory}
    assert handlers(PosedTracker).keys() == {Frame, GroundTruth}
    assert set(outputs(PosedTracker)) == {Keyframe, Poses, Trajectory}


@pytest.mark.slow
def test_tracker_sends_keyframes_then_poses_then_the_trajectory() -> None:
    frames, _ = messages()
    node = Tracker()
    sent = [m for frame in frames for m in node.on_frame(frame)] + list(node.on_end())
    keyframes, poses = of_type(sent, Keyframe), of_type(sent, Poses)
    assert isinstance(sent[-1], Trajectory)
    assert isinstance(sent[-2], Poses)
    assert len(of_type(sent, Trajectory)) == 1
    indices = [k.index for k in keyframes]
    assert indices == sorted(set(indices))
    for keyframe in keyframes:
        assert keyframe.scale == 1.0
        assert keyframe.image is frames[keyframe.index].image
        assert keyframe.inverse_depth.shape == keyframe.inverse_depth_weight.shape == (30, 40)
        assert keyframe.inverse_depth.dtype == keyframe.inverse_depth_weight.dtype == np.float32
        known = keyframe.inverse_depth > 0
        assert known.mean() > 0.3
        assert keyframe.inverse_depth_weight.min() >= 0
        assert keyframe.inverse_depth_weight.max() <= 1
        np.testing.assert_array_equal(known, keyframe.inverse_depth_weight > 0)
    assert [p.revision for p in poses] == list(range(1, len(poses) + 1))
    published: set[int] = set()
    for message in sent:  # nothing is corrected that was not sent before
        if isinstance(message, Keyframe):
            published.add(message.index)
        elif isinstance(message, Poses):
            assert set(message.index.tolist()) <= published
            assert np.all(message.scale > 0)
        elif isinstance(message, TrackedFrame):
            assert message.keyframe in published
    trajectory = sent[-1]
    np.testing.assert_array_equal(trajectory.index, [frame.index for frame in frames])
    assert trajectory.index[trajectory.keyframe].tolist() == indices
    np.testing.assert_array_equal(poses[-1].world_from_cam, trajectory.world_from_cam[trajectory.keyframe])
    assert trajectory.state.dtype == np.uint8
    assert trajectory.segment.dtype == np.int32
    assert node.stats.counts["frames"] == len(frames)
    assert "front end" in node.stats.seconds


@pytest.mark.slow
def test_frames_between_keyframes_are_sent_with_their_poses_and_no_held_out_one_is() -> None:
    frames, truths = messages()
    node = Tracker(Tracker.Config(frames_between=2))
    sent = [m for frame in frames for m in node.on_frame(frame)] + list(node.on_end())
    between, trajectory = of_type(sent, TrackedFrame), sent[-1]
    assert isinstance(trajectory, Trajectory)
    indices, keyframes = [b.index for b in between], [k.index for k in of_type(sent, Keyframe)]
    assert len(set(indices)) == len(indices) > 5
    assert not any(is_held_out(index) or index in keyframes for index in indices)
    assert min(indices) < keyframes[1]  # those of the start, too
    for before, after in itertools.pairwise(keyframes):
        assert sum(before < index < after for index in indices) <= 2
    for b in between:
        assert b.image is frames[b.index].image
        true = geometry.inverse(truths[b.keyframe].world_from_cam) @ truths[b.index].world_from_cam
        turned = true[:3, :3].T @ b.keyframe_from_cam[:3, :3]
        assert np.degrees(np.linalg.norm(turned - np.eye(3)) / np.sqrt(2.0)) < 0.1
        final = geometry.inverse(trajectory.world_from_cam[b.keyframe]) @ trajectory.world_from_cam[b.index]
        assert np.linalg.norm(final[:3, 3] - b.keyframe_from_cam[:3, 3]) < 0.01  # of about the median depth
    assert not of_type(list(Tracker(Tracker.Config(frames_between=0)).on_frame(frames[0])), TrackedFrame)
    with pytest.raises(ValueError, match=r"tracker\.frames_between=-1"):
        Tracker.Config(frames_between=-1)


@pytest.mark.slow
def test_changes_of_the_trackers_phase_are_sent() -> None:
    """A hand before the lens: nothing to search with; then noise, which is searched for in the map."""
    frames, _ = messages()
    black, noise = (
        np.zeros_like(frames[0].image),
        np.random.default_rng(0).integers(0, 256, frames[0].image.shape, np.uint8),
    )
    for start, image in ((32, black), (36, noise)):
        frames[start : start + 3] = [replace(frame, image=image) for frame in frames[start : start + 3]]
    node, phases = Tracker(), []
    for frame in frames[:42]:
        phases += of_type(list(node.on_frame(frame)), TrackerPhase)
        assert node.stats.values["tracking"] == (phases[-1].phase if phases else "initializing")
    assert [(p.index, p.phase) for p in phases[1:]] == [
        (32, "lost"), (35, "tracking"), (36, "relocalizing"), (39, "tracking"),
    ]  # fmt: skip
    assert phases[0].phase == "tracking"
    counts = node.stats.counts
    assert counts["frames while lost"] == counts["frames while relocalizing"] == 3
    assert counts["frames while initializing"] == phases[0].index
    assert sum(n for name, n in counts.items() if name.startswith("frames while ")) == 42


@pytest.mark.slow
def test_a_stream_too_short_for_a_start_is_forced_to_one_and_says_so() -> None:
    frames, _ = messages(16)
    node = Tracker()
    sent = [m for frame in frames for m in node.on_frame(frame)]
    assert sent == []
    sent = list(node.on_end())
    keyframes = of_type(sent, Keyframe)
    assert len(keyframes) >= 3
    assert all(k.image is frames[k.index].image for k in keyframes)
    assert any("forced" in warning for warning in node.stats.warnings)


@pytest.mark.slow
def test_a_guessed_focal_length_is_estimated_and_sent() -> None:
    frames, _ = messages()
    wrong = np.array([1.4, 1.4, 1.0, 1.0])
    node = Tracker()
    sent = []
    for frame in frames:
        sent += list(node.on_frame(Frame(frame.index, frame.timestamp, frame.image, frame.intrinsics * wrong, True)))
    sent += list(node.on_end())
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    keyframes = of_type(sent, Keyframe)
    assert keyframes
    for keyframe in keyframes:
        np.testing.assert_allclose(keyframe.intrinsics, frames[0].intrinsics, rtol=0.03)
        np.testing.assert_array_equal(
            keyframe.intrinsics[:2], trajectory.focal_factor * wrong[:2] * frames[0].intrinsics[:2]
        )
    assert node.stats.counts["focal length over its guess"] == trajectory.focal_factor


def test_a_stream_of_nothing_ends_with_an_empty_trajectory() -> None:
    for node in (Tracker(), PosedTracker()):
        sent = list(node.on_end())
        assert isinstance(sent[-1], Trajectory)
        assert sent[-1].world_from_cam.shape == (0, 4, 4)


@pytest.mark.slow
def test_no_pose_at_all_is_nothing_with_its_reason() -> None:
    frames, truths = messages(12)
    node = Tracker()
    for frame in frames:
        list(node.on_frame(replace(frame, image=np.full_like(frame.image, 128))))
    list(node.on_end())
    assert "no texture: 12 of 12 frames" in node.stats.values["nothing"]
    posed = PosedTracker()
    for frame, truth in zip(frames, truths):
        list(posed.on_frame(frame))
        list(posed.on_ground_truth(replace(truth, world_from_cam=None)))
    list(posed.on_end())
    assert "12 frames" in posed.stats.values["nothing"]


@pytest.mark.slow
def test_some_pose_is_something() -> None:
    frames, _ = messages(30)
    node = Tracker()
    for frame in frames:
        list(node.on_frame(frame))
    list(node.on_end())
    assert "nothing" not in node.stats.values


@pytest.mark.slow
def test_the_newest_view_is_sent() -> None:
    """Its frame is still there at the end, and the map gets it."""
    frames, truths = messages(40)
    for node in (Tracker(), PosedTracker()):
        sent = [m for frame in frames for m in node.on_frame(frame)]
        if isinstance(node, PosedTracker):
            sent += [m for truth in truths for m in node.on_ground_truth(truth)]
        sent += list(node.on_end())
        assert max(k.index for k in of_type(sent, Keyframe)) >= 38


@pytest.mark.slow
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


def run_posed(order: list[Frame | GroundTruth]) -> list[msgs.Message]:
    node = PosedTracker()
    sent: list[msgs.Message] = []
    for message in order:
        sent += node.on_frame(message) if isinstance(message, Frame) else node.on_ground_truth(message)
    return [*sent, *node.on_end()]


@pytest.mark.slow
def test_true_poses_come_with_depths_in_their_unit() -> None:
    frames, truths = messages()
    sent = run_posed([m for pair in zip(frames, truths) for m in pair])
    keyframes = of_type(sent, Keyframe)
    assert len(keyframes) >= 6
    ratios = []
    for keyframe in keyframes:
        truth = truths[keyframe.index]
        np.testing.assert_array_equal(keyframe.world_from_cam, truth.world_from_cam)
        assert truth.depth is not None
        depth = truth.depth.reshape(30, 8, 40, 8).transpose(0, 2, 1, 3).reshape(30, 40, 64)
        sure = keyframe.inverse_depth_weight > 0.5
        ratios.append((1.0 / keyframe.inverse_depth[sure]) / np.median(depth, axis=-1)[sure])
    ratio = np.concatenate(ratios)
    assert len(ratio) > 1000
    assert abs(np.median(ratio) - 1.0) < 0.02
    trajectory = sent[-1]
    assert isinstance(trajectory, Trajectory)
    np.testing.assert_array_equal(trajectory.world_from_cam, [t.world_from_cam for t in truths])
    assert trajectory.index[trajectory.keyframe].tolist() == [k.index for k in keyframes]


def test_true_poses_that_hardly_move_say_what_to_lower() -> None:
    frames, truths = messages(3)
    node = PosedTracker()
    for frame, truth in zip(frames, truths):
        list(node.on_frame(frame))
        list(node.on_ground_truth(truth))
    list(node.on_end())
    assert any("lower it" in warning for warning in node.stats.warnings)


def test_the_order_of_the_two_topics_does_not_matter() -> None:
    frames, truths = messages(30)
    truth_first = run_posed([*truths, *frames])
    frame_first = run_posed([*frames, *truths])
    assert len(of_type(truth_first, Keyframe)) >= 3
    for a, b in itertools.zip_longest(of_type(truth_first, Keyframe), of_type(frame_first, Keyframe)):
        assert a.index == b.index
        np.testing.assert_array_equal(a.inverse_depth, b.inverse_depth)


def test_frames_without_a_true_pose_are_left_out_and_reported() -> None:
    frames, truths = messages(20)
    blind = GroundTruth(3, truths[3].timestamp, truths[3].image, truths[3].intrinsics, None, None)
    node: Node = PosedTracker()
    assert isinstance(node, PosedTracker)
    for frame, truth in zip(frames, [*truths[:3], blind, *truths[4:]]):
        list(node.on_frame(frame))
        list(node.on_ground_truth(truth))
    trajectory = list(node.on_end())[-1]
    assert isinstance(trajectory, Trajectory)
    assert np.isnan(trajectory.world_from_cam[3]).all()
    assert trajectory.state[3] == TrackingState.LOST
    assert any("without a true pose" in warning for warning in node.stats.warnings)


def rolling_messages(count: int) -> tuple[list[Frame], list[GroundTruth]]:
    rolling = Synthetic(threads=1, rolling_shutter=0.5)
    items = [rolling[n] for n in range(count)]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in items]
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


@pytest.mark.slow
def test_keyframes_with_true_poses_are_as_a_global_shutter_would_have_taken_them() -> None:
    frames, truths = rolling_messages(30)
    node = PosedTracker(PosedTracker.Config(readout_time=0.5 / FPS))
    sent: list[msgs.Message] = []
    for frame, truth in zip(frames, truths, strict=True):
        sent += [*node.on_frame(frame), *node.on_ground_truth(truth)]
    sent += list(node.on_end())
    assert sent[-1].readout_time == 0.5 / FPS  # type: ignore[union-attr]
    check_global_shutter(of_type(sent, Keyframe), frames)
    check_photographs(of_type(sent, Keyframe), frames)


@pytest.mark.parametrize("node", [Tracker, PosedTracker])
@pytest.mark.parametrize("readout_time", [25.0, -0.01, float("nan")])
def test_a_readout_in_another_unit_is_refused(node: type[Tracker] | type[PosedTracker], readout_time: float) -> None:
    with pytest.raises(ValueError, match=r"tracker\.readout_time=.*seconds.*0 to 0\.2"):
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
