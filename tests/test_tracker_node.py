"""The tracker nodes: messages in, messages out."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import msgs
from msgs import (
    CameraPose,
    Frame,
    GroundTruth,
    Keyframe,
    Poses,
    Request,
    TrackedFrame,
    TrackerPhase,
    TrackingState,
    Trajectory,
)
from mvsgs_core import geometry
from mvsgs_core.held_out import is_held_out
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Correction, Update
from nodes import Node, handlers, outputs
from nodes.localizer import Localizer
from nodes.photographs_tracker import PhotographsTracker
from nodes.posed_tracker import PosedTracker
from nodes.tracker import Tracker
from nodes.tracking import TrackerNode
from tests.support import keyframe_messages
from tests.support.sequences import synthetic


def messages(count: int = 45) -> tuple[list[Frame], list[GroundTruth]]:
    items = synthetic(frames=80)[:count]
    frames = [Frame(i.index, i.timestamp, i.image, i.intrinsics) for i in items]
    truths = [GroundTruth(i.index, i.timestamp, i.image, i.intrinsics, i.world_from_cam, i.depth) for i in items]
    return frames, truths


def of_type(sent: list[msgs.Message], kind: type) -> list:  # type: ignore[type-arg]
    return [message for message in sent if isinstance(message, kind)]


def test_contracts() -> None:
    assert handlers(Tracker).keys() == {Frame, Request}
    assert set(outputs(Tracker)) == {Keyframe, Poses, TrackedFrame, CameraPose, TrackerPhase, Trajectory, Request}
    assert handlers(PosedTracker).keys() == {Frame, GroundTruth, Request}
    assert set(outputs(PosedTracker)) == {Keyframe, Poses, TrackedFrame, Trajectory, Request}


def test_a_tracker_that_can_only_be_paused_says_so() -> None:
    for node in (PosedTracker(), PhotographsTracker()):
        assert list(node.on_request(Request(1, "pause"))) == [Request(1, "pause")]
        (refused,) = node.on_request(Request(2, "reset"))
        assert isinstance(refused, Request)
        assert refused.problem == f"{type(node).__name__} cannot: start the run with tracker=dense"


@pytest.mark.slow
def test_a_request_that_cannot_be_met_changes_nothing_and_says_what_to_do(tmp_path: Path) -> None:
    def problem(node: Tracker, request: Request) -> str:
        (answered,) = [m for m in node.on_request(request) if isinstance(m, Request)]
        return answered.problem

    empty, kept = str(tmp_path / "empty"), str(tmp_path / "kept")
    node = Tracker()
    for asked in ("save_map", "localize"):
        assert "nothing is mapped yet" in problem(node, Request(1, asked, folder=kept))
    frames, _ = messages()
    for frame in frames:
        list(node.on_frame(frame))
    assert not problem(node, Request(2, "save_map", folder=kept))
    core = node.core
    assert "there is a map already" in problem(node, Request(3, "reset", kept=kept))
    assert "no such directory" in problem(node, Request(4, "load_map", folder=empty, kept=empty))
    assert "no tracker does that" in problem(node, Request(5, "fly"))
    assert node.core is core
    localizer = Localizer(Localizer.Config(map=kept))
    for asked, on in (("save_map", True), ("reset", True), ("localize", False)):
        assert "this run only localizes" in problem(localizer, Request(6, asked, on, empty, empty))
    assert not problem(localizer, Request(7, "localize"))
    assert not Path(empty).exists()
    assert not problem(node, Request(8, "reset", kept=empty))
    list(node.on_end())
    assert node.stats.values["nothing"] == (
        f"no frame came after another map was begun on request; the one before is in {empty}"
    )


def test_what_an_update_corrects_is_known_before_its_keyframes() -> None:
    """Stereo looks at a new keyframe and at those around it as soon as it comes: all must stand in one map."""

    class Sending(TrackerNode):
        core = SimpleNamespace(stats=Stats(), pending=set(), phase=Phase.TRACKING, nothing="")  # type: ignore[assignment]

        def _add(self, frame: Frame) -> Update:
            correction = Correction(np.array([frame.index - 1]), np.eye(4)[None], np.ones(1))
            return Update(TrackingState.TRACKED, (frame.index,), correction)

        def _keyframe(self, index: int) -> Keyframe:
            return keyframe_messages.keyframe(index)

    sent = list(Sending().on_frame(Frame(3, 0.3, np.zeros((2, 2, 3), np.uint8), np.ones(4))))
    assert [type(message) for message in sent[:2]] == [Poses, Keyframe]


@pytest.mark.slow
def test_tracker_sends_keyframes_and_poses_then_the_trajectory() -> None:
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
    assert counts["frames while initializing"] == phases[0].index + 1  # the one that it begins with has no pose yet
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
        given, original = frame.intrinsics * wrong, frame.intrinsics * wrong * 3.0
        shrunk = Frame(frame.index, frame.timestamp, frame.image, given, True, original_intrinsics=original)
        sent += list(node.on_frame(shrunk))
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
    told = node.stats.values["focal_px"]  # as `dataset.intrinsics` is given
    assert told == pytest.approx(3.0 * wrong[0] * frames[0].intrinsics[0] * trajectory.focal_factor)


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
def run_posed(order: list[Frame | GroundTruth]) -> list[msgs.Message]:
    node = PosedTracker()
    sent: list[msgs.Message] = []
    for message in order:
        sent += node.on_frame(message) if isinstance(message, Frame) else node.on_ground_truth(message)
    return [*sent, *node.on_end()]


def test_with_true_poses_only_exposures_that_may_have_changed_are_looked_at() -> None:
    """Not those of all keyframes at each one: of a long stream that is the square of their number."""
    made_of = {index: object() for index in range(100)}
    asked: list[int] = []
    gains = dict.fromkeys(made_of, 1.0)

    def exposure(index: int) -> np.ndarray:
        asked.append(index)
        return np.asarray(gains[index] * np.eye(3, 4, dtype=np.float32))

    core: Any = SimpleNamespace(photometer=SimpleNamespace(vignetting=None, known=made_of.get, exposure=exposure))
    node = PosedTracker()
    node._joined = dict.fromkeys(made_of, (0.0, np.eye(4)))
    node._keyframes = dict.fromkeys(made_of)
    assert list(node._exposed(core)) == []
    assert asked == list(made_of), "each of them once"
    made_of[7], gains[7] = object(), 1.2
    (sent,) = node._exposed(core)
    assert asked[100:] == sent.index.tolist() == [7]
    assert list(node._exposed(core)) == []
    core.photometer.vignetting = np.array([-0.3, 0.0, 0.0], np.float32)
    (sent,) = node._exposed(core)
    assert sent.index.tolist() == list(made_of), "all go with a vignetting"


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


def test_gps_goes_with_the_trajectory() -> None:
    place, none = np.array([47.0, 8.0, 400.0]), np.zeros(3)  # as a receiver without a fix sends it
    image, intrinsics = np.full((48, 64, 3), 128, np.uint8), np.array([60.0, 60.0, 31.5, 23.5])
    for node in (Tracker(), PosedTracker(), PhotographsTracker()):
        for n, given in enumerate((place, None, none)):
            list(node.on_frame(Frame(n, n / 30, image, intrinsics, place=given)))
            truth = GroundTruth(n, n / 30, image, intrinsics, np.eye(4), None)
            list(node.on_ground_truth(truth) if isinstance(node, PosedTracker) else ())
        trajectory = list(node.on_end())[-1]
        assert isinstance(trajectory, Trajectory)
        np.testing.assert_array_equal(trajectory.places, [place, [np.nan] * 3, [np.nan] * 3])


def test_true_poses_that_hardly_move_say_what_to_lower() -> None:
    frames, truths = messages(2)
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
