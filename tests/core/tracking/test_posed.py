"""The tracker with true poses: their unit may be anything."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.held_out import is_held_out
from mvsgs_core.tracking.config import PosedConfig
from mvsgs_core.tracking.posed import PosedTracker
from tests.support.sequences import synthetic


def depths(factor: float, count: int = 40) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By keyframe: its depths, which of them are triangulated, and its position, poses being `factor` times larger."""
    items = synthetic(frames=80)[:count]
    tracker = PosedTracker(PosedConfig(), (240, 320), items[0].intrinsics)
    complete: list[int] = []
    for item in items:
        pose = np.array(item.world_from_cam)
        pose[:3, 3] *= factor
        complete += tracker.add(item.index, item.timestamp, item.image, pose)
    complete += tracker.finish()
    keyframes = {index: tracker.keyframe(index) for index in complete}
    return {
        i: (1.0 / k.inverse_depth, k.triangulated, np.linalg.inv(k.cam_from_world)[:3, 3]) for i, k in keyframes.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_the_unit_of_the_poses_does_not_matter(factor: float) -> None:
    plain, scaled = depths(1.0), depths(factor)
    assert plain.keys() == scaled.keys()
    for index, (depth, known, position) in plain.items():
        other, other_known, other_position = scaled[index]
        assert np.mean(known == other_known) > 0.99
        np.testing.assert_allclose(other_position, factor * position, rtol=1e-9, atol=1e-9 * factor)
        both = known & other_known
        assert np.quantile(np.abs(other[both] / (factor * depth[both]) - 1.0), 0.99) < 0.01


@pytest.mark.slow
def test_held_out_frames_are_no_keyframes_and_the_newest_view_is_one() -> None:
    keyframes = list(depths(1.0))
    assert len(keyframes) >= 5
    assert not [k for k in keyframes if is_held_out(k)]
    assert keyframes[-1] >= 38, "the newest view"


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0, 2, 8])
def test_frames_between_keyframes_have_their_given_poses_and_no_held_out_one_is_among_them(limit: int) -> None:
    items = synthetic(frames=80)[:40]
    tracker = PosedTracker(PosedConfig(frames_between=limit), (240, 320), items[0].intrinsics)
    found, keyframes = [], []
    for item in [*items, None]:
        if item is None:
            complete = tracker.finish()
        else:
            complete = tracker.add(item.index, item.timestamp, item.image, item.world_from_cam)
        for index in complete:
            keyframes.append(index)
            between = tracker.between(index)
            assert len(between) <= limit
            found += between
    indices = [each.index for each in found]
    assert len(set(indices)) == len(indices)
    assert not any(is_held_out(index) or index in keyframes for index in indices)
    if limit == 8:
        assert len(indices) + len(keyframes) == sum(not is_held_out(item.index) for item in items)
    for each in found:
        true = np.linalg.inv(items[each.keyframe].world_from_cam) @ items[each.index].world_from_cam
        np.testing.assert_allclose(each.keyframe_from_cam, true, atol=1e-9)
        assert each.exposure is None  # under steady light
    assert tracker.pending == set()
    with pytest.raises(ValueError, match=r"tracker\.frames_between=-1"):
        PosedConfig(frames_between=-1)
