"""The whole tracker on the synthetic room, with what is difficult, and on a real sequence."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.datasets import open_dataset
from mvsgs_core.tracking.front_end import FrontEnd, Step
from mvsgs_core.tracking.matching.flow import FLOWS
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch
from mvsgs_core.tracking.tracker import TrackerConfig
from mvsgs_core.trajectory import TrackingState
from tests.support.sequences import ate, synthetic, track, tracked_room
from tests.support.shared_data import shared

pytestmark = pytest.mark.slow


def test_the_room_is_tracked_from_the_first_frame_to_the_last() -> None:
    items = synthetic(frames=80)
    tracker, trajectory, updates = tracked_room()
    error, length = ate(trajectory, items)
    assert error < 0.003 * length
    assert (trajectory.state == TrackingState.TRACKED).all()
    assert np.isfinite(trajectory.world_from_cam).all()
    published = [index for update in updates for index in update.keyframes]
    assert sorted(published) == sorted(set(published)) == trajectory.index[trajectory.keyframe].tolist()
    assert 8 <= len(published) <= 30
    assert tracker.stats.warnings == []


@pytest.mark.parametrize("haze", [0.0, 180.0])
def test_the_room_is_tracked_in_the_dark_and_in_haze(haze: float) -> None:
    """Texture is measured in gray levels: in a tenth of the light, or of the contrast, there was none."""
    rng, clear = np.random.default_rng(0), synthetic(frames=80)
    noise = [rng.normal(haze, 1.5, item.image.shape) for item in clear]
    items = [replace(i, image=(0.1 * i.image + n).clip(0, 255).astype(np.uint8)) for i, n in zip(clear, noise)]
    _, trajectory, _ = track(items)
    error, length = ate(trajectory, items)
    assert (trajectory.state == TrackingState.TRACKED).all()
    assert error < 0.003 * length


@pytest.mark.parametrize("flow", sorted(FLOWS.keys() - {"raft_small"}))  # a network: `bench.learned` tracks with it
def test_every_choice_of_flow_without_weights_starts_and_tracks(flow: str) -> None:
    items = synthetic(frames=80)[:28]
    tracker, trajectory, updates = track(items, TrackerConfig(flow=flow))
    assert any(update.keyframes for update in updates[: len(items)]), tracker.session.initializer.reason
    assert tracker.stats.warnings == []
    assert (trajectory.state == TrackingState.TRACKED).all()
    error, length = ate(trajectory, items)
    assert error < 0.003 * length


def test_depths_agree_with_the_truth() -> None:
    items = synthetic(frames=80)
    tracker, trajectory, _ = tracked_room()
    found, true = trajectory.world_from_cam[:, :3, 3], np.stack([np.asarray(i.world_from_cam)[:3, 3] for i in items])
    scale = geometry.umeyama(found, true).scale
    ratios, known = [], []
    for index in trajectory.index[trajectory.keyframe][2:-2]:
        keyframe, depth = tracker.keyframe(int(index)), items[int(index)].depth
        assert depth is not None
        u, v = keyframe.points.astype(int).T
        use = keyframe.triangulated & (depth[v, u] > 0)
        ratios.append(scale / keyframe.inverse_depth[use] / depth[v, u][use])
        known.append(use.mean())
    ratio = np.concatenate(ratios)
    assert np.mean(known) > 0.5
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert np.mean(np.abs(ratio - 1.0) < 0.1) > 0.85


def test_the_same_frames_give_the_same_path() -> None:
    items = synthetic(frames=80)[:35]
    (_, first, _), (_, second, _) = track(items), track(items)
    np.testing.assert_array_equal(first.world_from_cam, second.world_from_cam)


def test_corrections_end_where_the_path_is() -> None:
    _, trajectory, updates = tracked_room()
    last = next(u.correction for u in reversed(updates) if u.correction is not None)
    keyframes = trajectory.keyframe
    np.testing.assert_array_equal(last.index, trajectory.index[keyframes])
    np.testing.assert_array_equal(last.world_from_cam, trajectory.world_from_cam[keyframes])
    assert np.all((last.scale > 0.8) & (last.scale < 1.25))


def test_a_turning_start_waits_for_parallax_and_is_filled_in_later() -> None:
    items = synthetic(frames=75, pure_rotation=20)
    _, trajectory, updates = track(items)
    first = next(n for n, u in enumerate(updates) if u.keyframes)
    assert first >= 20, "a start was made of nothing but rotation"
    error, length = ate(trajectory, items)
    assert error < 0.01 * length
    assert np.mean(trajectory.state == TrackingState.TRACKED) > 0.9


def test_bad_frames_before_the_start_cost_no_other_than_themselves() -> None:
    """A slow camera: a start takes longer than from one of them to the next."""
    random, items = np.random.default_rng(0), list(synthetic(frames=600, stop=100))
    bad = range(7, len(items), 15)
    for n in bad:
        items[n] = replace(items[n], image=random.integers(0, 255, items[n].image.shape, dtype=np.uint8))
    _, trajectory, updates = track(items)
    assert any(update.keyframes for update in updates[: len(items)])
    known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    assert trajectory.index[~known].tolist() == list(bad)
    error, length = ate(trajectory, items)
    assert error < 0.01 * length


def test_a_camera_that_is_elsewhere_before_the_start_begins_anew_with_its_first_frame_there() -> None:
    elsewhere = synthetic(frames=40, scene="aerial")
    items = [replace(i, index=n, timestamp=n / 20.0) for n, i in enumerate([*synthetic(frames=80)[:8], *elsewhere])]
    _, trajectory, _ = track(items)
    known = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2))
    assert known.tolist() == [False] * 8 + [True] * len(elsewhere)
    assert set(trajectory.segment[known].tolist()) == {0}


def test_a_covered_lens_is_lost_and_found_again() -> None:
    items = synthetic(frames=90, covered=12, covered_start=50)
    tracker, trajectory, updates = track(items)
    assert (trajectory.state[50:62] == TrackingState.LOST).all()
    assert not np.isfinite(trajectory.world_from_cam[50:62]).any()
    assert (trajectory.state[64:] == TrackingState.TRACKED).all()
    assert len({int(s) for s in trajectory.segment[trajectory.segment >= 0]}) == 1
    assert not any(update.keyframes for update in updates[50:62])
    assert any("lost" in warning for warning in tracker.stats.warnings)
    assert tracker.stats.counts["frames while lost"] == 12
    assert tracker.phase is Phase.TRACKING
    error, length = ate(trajectory, items)
    assert error < 0.01 * length


def test_a_jump_to_a_known_place_is_relocalized() -> None:
    room = synthetic(frames=80)[:60]
    items = [type(i)(n, n / 20.0, i.image, i.intrinsics, i.world_from_cam) for n, i in enumerate([*room, *room[2:8]])]
    tracker, trajectory, updates = track(items)
    assert tracker.stats.counts["relocalized"] == 1
    assert tracker.phase is Phase.TRACKING
    assert all(update.state == TrackingState.TRACKED for update in updates[60:66])
    assert set(trajectory.segment.tolist()) == {0}
    shift = trajectory.world_from_cam[60:, :3, 3] - trajectory.world_from_cam[2:8, :3, 3]
    step = np.linalg.norm(np.diff(trajectory.world_from_cam[2:8, :3, 3], axis=0), axis=1).mean()
    assert np.linalg.norm(shift, axis=1).max() < 0.5 * step, "where it was before"


def test_a_camera_that_is_found_with_few_of_the_map_s_points_goes_on_from_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Covered for 40 frames, it comes back where few of the points of the last keyframes are seen.
    items = synthetic(frames=120, covered=40)
    tracker, trajectory, _ = track(items)
    assert tracker.stats.counts["relocalized"] <= 2
    assert set(trajectory.segment.tolist()) == {-1, 0}
    assert min(trajectory.index[trajectory.keyframe & (trajectory.index >= 100)]) <= 102
    error, length = ate(trajectory, items)
    assert error < 0.01 * length
    found = FrontEnd.found

    def with_many(self: FrontEnd, place: PlaceMatch) -> Step:
        return replace(found(self, place), fraction=1.0)

    monkeypatch.setattr(FrontEnd, "found", with_many)
    assert track(items)[0].stats.counts["relocalized"] > 2, "else this scene tests nothing"


def test_a_jump_to_an_unseen_place_starts_a_segment_of_its_own() -> None:
    room = synthetic(frames=80)
    elsewhere = synthetic(frames=40, scene="aerial")
    items = list(room[:30])
    for item in elsewhere:
        n = len(items)
        items.append(type(item)(n, n / 20.0, item.image, item.intrinsics, item.world_from_cam, item.depth))
    tracker, trajectory, _ = track(items)
    assert (trajectory.segment[:30] == 0).all()
    assert (trajectory.segment[37:] == 1).all()
    for segment in (0, 1):
        error, length = ate(trajectory, items, trajectory.segment == segment)
        assert error < 0.02 * length
    assert any("2 segments" in warning for warning in tracker.stats.warnings)
    patience = tracker.config.relocalization.patience
    assert tracker.stats.counts["frames while relocalizing"] == patience - 1, "the next one begins a segment"


def test_a_room_without_texture_is_not_tracked_and_says_so() -> None:
    items = [
        type(item)(item.index, item.timestamp, np.full_like(item.image, 128), item.intrinsics)
        for item in synthetic(frames=80)[:10]
    ]
    tracker, trajectory, updates = track(items)
    assert (trajectory.state == TrackingState.NOT_INITIALIZED).all()
    assert not any(update.keyframes for update in updates)
    assert any("never started" in warning for warning in tracker.stats.warnings)


def test_a_camera_at_rest_makes_no_keyframes() -> None:
    items = synthetic(frames=80)
    still = [type(i)(n, n / 20.0, items[40].image, i.intrinsics) for n, i in zip(range(41, 61), items)]
    moving = list(items[:41])
    tracker, trajectory, updates = track(moving + still)
    assert not any(update.keyframes for update in updates[41:61])
    assert tracker.stats.skipped["frames that did not move"] >= 19
    shift = np.linalg.norm(trajectory.world_from_cam[41:, :3, 3] - trajectory.world_from_cam[40, :3, 3], axis=1)
    assert shift.max() < 1e-3


def test_a_lamp_that_comes_into_view_in_a_dark_room_costs_no_frame() -> None:
    """All of the picture would have another gain from one frame to the next."""
    items = []
    for item in synthetic(frames=80)[:40]:
        dark = (0.1 * item.image).astype(np.uint8)
        if item.index >= 25:
            cv2.circle(dark, (400 - 6 * item.index, 60), 24, (255, 255, 255), -1, cv2.LINE_AA)
        items.append(replace(item, image=dark))
    tracker, trajectory, _ = track(items)
    error, length = ate(trajectory, items)
    assert error < 0.005 * length
    assert (trajectory.state == TrackingState.TRACKED).all()
    assert tracker.phase is Phase.TRACKING


def test_a_real_hand_held_sequence() -> None:
    items = list(open_dataset("tum", path=shared("data/tum_fr1_xyz"), stop=60))
    _, trajectory, _ = track(items)
    known = np.isin(trajectory.index, [i.index for i in items if i.world_from_cam is not None])
    error, _ = ate(trajectory, items, known)
    assert error < 0.015, "meters"
    assert (trajectory.state == TrackingState.TRACKED).all()


@pytest.mark.parametrize("start", [0, 1])
def test_a_drive_with_wide_steps_keeps_its_scale(start: int) -> None:
    """Two meters a frame, straight on: few points are seen by three keyframes, and the scale hangs on them."""
    items = list(open_dataset("tum", path=shared("data/kitti_piece"), start=start, stride=2))
    _, trajectory, _ = track(items)
    error, length = ate(trajectory, items)
    assert np.isfinite(trajectory.world_from_cam).all()
    assert error < 0.001 * length, ".12 % from the first where the image has 152 rows"


@pytest.mark.parametrize("start", [0, 1, 2])
def test_a_drive_with_steps_of_six_meters_is_followed(start: int) -> None:
    items = list(open_dataset("tum", path=shared("data/kitti_piece"), start=start, stride=5))
    _, trajectory, _ = track(items)
    assert np.isfinite(trajectory.world_from_cam).all(axis=(1, 2)).sum() >= 9
    error, length = ate(trajectory, items)
    assert error < 0.002 * length
