"""The tracker in real time: frames get their poses while a keyframe is worked on, as there is time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

import msgs
from msgs import CameraPose, Frame, Keyframe, TrackedFrame, TrackerPhase, Trajectory
from mvsgs_core import geometry
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.tracking.steps import Steps, whole
from mvsgs_core.tracking.tracker import Tracker as CoreTracker
from mvsgs_core.trajectory import TrackingState
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


def keyframes_of(sent: Sequence[msgs.Message]) -> list[Keyframe]:
    return [m for m in sent if isinstance(m, Keyframe)]


def split(sent: list[msgs.Message]) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], Trajectory]:
    """Poses of keyframes and of frames between, by index, and the trajectory."""
    keyframes = {m.index: m.world_from_cam for m in sent if isinstance(m, Keyframe)}
    between = {m.index: m.keyframe_from_cam for m in sent if isinstance(m, TrackedFrame)}
    (trajectory,) = (m for m in sent if isinstance(m, Trajectory))
    return keyframes, between, trajectory


@pytest.mark.slow
def test_with_time_for_it_all_comes_out_as_without_hurry() -> None:
    unhurried = split(list(sent_by(Tracker())))
    node = Tracker(Tracker.Config(realtime=True, share=1.0))  # frames come without a pause
    live = split(list(sent_by(node)))
    for one, other in zip(unhurried[:2], live[:2], strict=True):
        assert one.keys() == other.keys()
        for index in one:
            np.testing.assert_array_equal(one[index], other[index])
    np.testing.assert_array_equal(unhurried[2].world_from_cam, live[2].world_from_cam)
    assert SKIPPED not in node.stats.skipped


@pytest.mark.slow
def test_frames_get_their_poses_while_a_keyframe_is_worked_on() -> None:
    node, unhurried = Tracker(Tracker.Config(realtime=True, share=1.0)), split(list(sent_by(Tracker())))
    meanwhile, begun = 0, 0
    sent: list[msgs.Message] = []
    for frame in frames():
        at_work = begun > len(keyframes_of(sent))
        here = list(node.on_frame(replace(frame, captured=time.time())))
        first = bool(here) and isinstance(here[0], CameraPose)
        meanwhile += at_work and first and not keyframes_of(here)
        sent += here
        begun = len(node.core.session.graph.keyframes)
        if at_work:  # what it takes is done between the next two frames
            while (found := node.on_idle()) is not None:
                sent += found
            begun = len(keyframes_of(sent))
    live = split([*sent, *node.on_end()])
    assert meanwhile > 2
    both = unhurried[0].keys() & live[0].keys()
    assert len(both) > 5
    off = [np.abs(pose - live[0][index]).max() for index, pose in unhurried[0].items() if index in both]
    assert max(off) < 0.02
    known = np.isfinite(unhurried[2].world_from_cam[:, 0, 0])
    assert np.isfinite(live[2].world_from_cam[known]).all()
    np.testing.assert_allclose(live[2].world_from_cam[known], unhurried[2].world_from_cam[known], atol=0.02)
    assert node.stats.values["latency"]["frame to pose"]["count"] > 10


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


def followed(core: CoreTracker, frame: Frame) -> Update:
    return core.follow(frame.index, frame.timestamp, frame.image, frame.intrinsics)


@pytest.mark.slow
def test_a_frame_that_went_as_far_while_a_keyframe_was_worked_on_is_one_at_once() -> None:
    core, coming = CoreTracker(), iter(frames(80))
    for frame in coming:  # to the first keyframe after the start
        update = followed(core, frame)
        if update.rest is not None and core.phase is Phase.TRACKING:
            break
        update.whole()
    assert update.rest is not None
    begun, front_end = frame.index, core.session.front_end
    while front_end.reference is None or front_end.reference.index < begun:
        next(update.rest)
    while not core.late:  # frames are followed from it meanwhile, to where the next may be lost
        frame = next(coming)
        assert followed(core, frame).rest is None
    after = whole(update.rest)
    assert after.keyframes == (begun,)
    assert after.rest is not None
    again = whole(after.rest)
    assert again.keyframes == (frame.index,)
    assert again.rest is None


@pytest.mark.slow
@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_frame_that_came_before_a_loop_is_a_keyframe_where_the_map_is_after_it(
    at_the_end: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What comes while a keyframe is tied to the map is followed from it, in the world as it was then."""
    core, coming = CoreTracker(), iter(frames(80))
    for frame in coming:
        update = followed(core, frame)
        if update.rest is not None and frame.index > 30 and core.phase is Phase.TRACKING:
            break
        update.whole()
    assert update.rest is not None
    first, session = frame.index, core.session
    while session.front_end.reference is None or session.front_end.reference.index < first:
        next(update.rest)
    for _ in range(4):
        frame = next(coming)
        assert followed(core, frame).rest is None
    joined = geometry.se3_exp(np.array([4.0, -3.0, 2.0, 0.3, 1.0, -0.5]))

    def joining(index: int) -> Steps[None]:
        for keyframe in session.graph.keyframes.values():
            keyframe.cam_from_world = keyframe.cam_from_world @ joined
        session.graph.rescale(list(session.graph.keyframes), 3.0)
        yield

    monkeypatch.setattr(session.keyframe_work, "_close_loops", joining)
    monkeypatch.setattr(session.choice, "is_late", lambda *_: not at_the_end)
    update = whole(update.rest)
    monkeypatch.undo()
    assert (update.rest is None) == at_the_end
    if update.rest is None:
        list(core.finish())
    else:
        assert whole(update.rest).state is TrackingState.TRACKED
    assert core.stats.counts.get("keyframes taken back", 0) == 0
    keyframes = sorted(session.graph.keyframes)
    assert keyframes[-1] > first
    found = np.stack([session.graph.world_from_cam(n)[:3, 3] for n in keyframes])
    true = np.stack([np.asarray(synthetic(frames=80)[n].world_from_cam)[:3, 3] for n in keyframes])
    assert np.abs(geometry.umeyama(found, true).apply(found) - true).max() < 0.01


@pytest.mark.slow
def test_every_keyframe_is_sent_where_the_stream_ends_with_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last frame is held out, and so far from the one before, which becomes a keyframe, that it is one as well."""
    given = frames(80)
    made = CoreTracker()
    for frame in given[:39]:
        followed(made, frame).whole()
    monkeypatch.setattr("mvsgs_core.tracking.keyframe_choice.LAST", 0.0)
    monkeypatch.setattr("mvsgs_core.tracking.keyframe_choice.is_held_out", lambda index: index == 40)
    monkeypatch.setattr(made.session.choice, "wants", lambda *_: False)
    for frame in (given[39], given[40]):
        followed(made, frame).whole()
    assert {39, 40} <= made.session._tail.indices
    before = set(made.session.publisher.published)
    monkeypatch.setattr(made.session.choice, "is_late", lambda *_: True)
    updates = list(made.finish())
    sent = [index for update in updates for index in update.keyframes]
    assert sent == [39, 40]
    assert set(sent) == made.session.publisher.published - before
    assert all(update.rest is None for update in updates)


@pytest.mark.slow
def test_whether_the_camera_would_be_followed_is_asked_without_a_trace() -> None:
    given, asked = frames(60), CoreTracker()
    tracked = [CoreTracker(), asked]
    assert not asked.follows(0, 0.0, given[0].image), "there is no map"
    for frame in given[:45]:
        updates = [followed(core, frame).whole() for core in tracked]
        if updates[1].state is TrackingState.TRACKED and frame.index < 40:
            assert asked.follows(frame.index + 1, given[frame.index + 1].timestamp, given[frame.index + 1].image)
            assert not asked.follows(59, given[59].timestamp, np.ascontiguousarray(given[59].image[:, ::-1]))
    for core in tracked:
        list(core.finish())
    np.testing.assert_array_equal(*(core.trajectory().world_from_cam for core in tracked))
