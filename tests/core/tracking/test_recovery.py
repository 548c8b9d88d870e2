"""Frames that had no pose when they came: found in the end where the map verifies them, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.frames import FrameRecord, TrackingState, solve_trajectory
from mvsgs_core.tracking.front_end import FrontEndConfig
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.places.recovery import Recovery, RecoveryConfig
from mvsgs_core.tracking.places.relocalization import RelocalizationConfig
from mvsgs_core.tracking.tracker import Tracker
from tests.support.sequences import synthetic, track
from tests.support.shared_data import shared
from tests.support.true_maps import image, matcher, pose_error, shuffled, true_graph, true_pose

pytestmark = pytest.mark.slow


def covered(items: list[Item], noisy: range, black: range) -> list[Item]:
    """Images of noise, which are textured, and black ones, which are not."""
    random = np.random.default_rng(0)
    result = list(items)
    for n in noisy:
        image = random.integers(0, 256, items[n].image.shape, np.uint8)
        result[n] = replace(items[n], image=image)
    for n in black:
        result[n] = replace(items[n], image=np.zeros_like(items[n].image))
    return result


def test_a_lost_run_that_begins_with_black_frames_does_not_end_the_tracker() -> None:
    items = covered(list(synthetic(frames=80)), range(44, 47), range(47, 50))[:60]
    _, trajectory, _ = track(items)
    known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    assert known[:44].all()
    assert not known[44:50].any()
    assert known[51:].all()
    assert (trajectory.state[44:50] == TrackingState.LOST).all()


def test_each_lost_run_is_followed_from_its_own_keyframes() -> None:
    """The second run's first frame has no image: it must not go on from where the first run was followed to."""
    items = covered(list(synthetic(frames=80)), range(30, 32), range(0))
    items = covered(items, range(47, 49), range(49, 51))[:62]
    _, trajectory, _ = track(items)
    known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    lost = [*range(30, 32), *range(47, 51)]
    assert not known[lost].any()
    truth = np.stack([np.asarray(i.world_from_cam) for i in items])
    found, true = trajectory.world_from_cam[known, :3, 3], truth[known, :3, 3]
    errors = np.linalg.norm(geometry.umeyama(found, true).apply(found) - true, axis=1)
    assert errors.max() < 0.02, "meters"


def test_only_the_newest_images_of_frames_without_a_pose_are_kept() -> None:
    items = covered(list(synthetic(frames=80)), range(40, 52), range(0))[:60]
    tracker, _, _ = track(
        items, TrackerConfig(recovery=RecoveryConfig(max_images=5), relocalization=RelocalizationConfig(patience=100))
    )
    assert len(tracker.session.recovery._images) == 5
    assert min(tracker.session.recovery._images) >= 40


def test_frames_before_the_start_are_verified_or_have_no_pose() -> None:
    """A car drives straight on: 12 frames before the first keyframe, what is found of it no longer tells where."""
    before = 12
    items = list(open_dataset("tum", path=shared("data/kitti_piece")))
    tracker = Tracker()
    session = tracker.begin(items[0].image.shape[:2], items[0].intrinsics)
    for item in items[:before]:  # as a start leaves them that was given up
        session.records.append(FrameRecord(item.index, item.timestamp, TrackingState.NOT_INITIALIZED))
        session.recovery.keep(TrackingImage.of(item.index, item.timestamp, item.image, session.size, False))
    for item in items[before:]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    list(tracker.finish())
    trajectory = tracker.trajectory()
    known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    np.testing.assert_array_equal(known, np.isin(trajectory.state, (TrackingState.TRACKED, TrackingState.DEGENERATE)))
    assert known[8:].all(), "what is verified is posed"
    truth = np.stack([np.asarray(i.world_from_cam) for i in items])
    found, true, keyframe = trajectory.world_from_cam[:, :3, 3], truth[:, :3, 3], trajectory.keyframe
    aligned = geometry.umeyama(found[keyframe], true[keyframe]).apply(found)
    errors = np.linalg.norm(aligned - true, axis=1)[known]
    assert errors.max() < 0.2, "meters: frames that nothing verified were up to 0.32 off"
    assert any("have no pose" in warning for warning in tracker.stats.warnings)


def recovery(*keyframes: int, max_images: int = 400) -> Recovery:
    return Recovery(true_graph(*keyframes), matcher(), RecoveryConfig(max_images), FrontEndConfig())


def records(numbers: Sequence[int], keyframes: Sequence[int]) -> list[FrameRecord]:
    return [FrameRecord(n, n / 20.0, TrackingState.TRACKED if n in keyframes else TrackingState.LOST) for n in numbers]


@pytest.mark.parametrize(("keyframes", "reference"), [((100,), 100), ((108,), 108), ((100, 108), 108)])
def test_frames_between_true_keyframes_get_their_true_poses(keyframes: tuple[int, ...], reference: int) -> None:
    """Forward from the keyframe before, backward from the one after; from the one after where there are both."""
    lost = recovery(*keyframes)
    numbers = range(100, 109)
    seen = records(numbers, keyframes)
    for record in seen:
        if record.index not in keyframes:
            lost.keep(image(record.index))
    assert lost.fill_in(seen) == len(numbers) - len(keyframes)
    assert {r.reference for r in seen if r.index not in keyframes} == {reference}
    trajectory = solve_trajectory(seen, lost.graph, Solver(steps=8))
    assert (trajectory.state == TrackingState.TRACKED).all()
    for number, pose in zip(numbers, trajectory.world_from_cam):
        shift, turn = pose_error(geometry.inverse(pose), true_pose(number))
        assert shift < 0.005, "meters"
        assert turn < 0.003


def test_what_no_keyframe_sees_stays_without_a_pose() -> None:
    lost = recovery(100)
    seen = records([100, 101, 102, 103, 104, 105], [100])
    for frame in (image(101), image(220, 102), image(103), image(104)):  # nothing was kept of 105
        lost.keep(frame)
    seen[4].same_as = 103
    assert lost.fill_in(seen) == 2
    assert [r.reference for r in seen] == [None, 100, None, 100, None, None]
    assert lost.fill_in(seen) == 0, "what has a pose keeps it"


@pytest.mark.parametrize(
    ("config", "front_end"),
    [
        (RecoveryConfig(criteria=PoseCriteria(min_matches=10_000)), FrontEndConfig()),
        (RecoveryConfig(), FrontEndConfig(lost_fraction=0.999)),
    ],
)
def test_poses_that_are_uncertain_or_of_lost_frames_are_none(config: RecoveryConfig, front_end: FrontEndConfig) -> None:
    lost = Recovery(true_graph(100), matcher(), config, front_end)
    seen = records([100, 101], [100])
    lost.keep(image(101))
    assert lost.fill_in(seen) == 0
    assert seen[1].reference is None


def test_images_keep_no_pyramids() -> None:
    """Those of 400 would be a fifth of a gigabyte."""
    lost = recovery(100, 200)
    seen = records([100, 101, 102, 103, 200], [100, 200])
    for frame in (image(101), image(20, 102), shuffled(103, 103)):
        lost.keep(frame)
    assert lost.fill_in(seen) == 1
    images = [*lost._images.values(), *(keyframe.image for keyframe in lost.graph.keyframes.values())]
    assert not [each.index for each in images if "pyramid" in vars(each)]


def test_the_oldest_images_go_first() -> None:
    lost = recovery(100, max_images=2)
    seen = records([100, 101, 102, 103], [100])
    for number in (101, 102, 103):
        lost.keep(image(number))
    assert lost.fill_in(seen) == 2
    assert [r.reference for r in seen] == [None, None, 100, 100]
