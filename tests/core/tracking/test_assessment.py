"""What the tracker says of how far its result can be trusted, and what it does about small images."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.tracking.image import tracking_size
from mvsgs_core.tracking.tracker import TrackerConfig
from tests.support.sequences import ate, synthetic, track, tracked_room


@pytest.mark.parametrize(
    ("size", "expected"),
    [((480, 640), (240, 320)), ((240, 320), (240, 320)), ((120, 160), (240, 320)), ((48, 64), (96, 128))],
)
def test_small_images_are_enlarged_at_most_twice(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert tracking_size(*size, 320 * 240) == expected


@pytest.mark.parametrize(("size", "expected"), [((540, 960), (208, 368)), ((370, 1226), (208, 688))])
def test_wide_images_keep_the_rows_of_16_to_9(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert tracking_size(*size, 320 * 240) == expected
    assert tracking_size(*size[::-1], 320 * 240) == expected[::-1]


@pytest.mark.slow
def test_small_images_do_not_bend_the_map() -> None:
    """At 160x120 itself, depths were 9 % off the scale of the trajectory, and the error of the trajectory 0.4 %."""
    items = synthetic(frames=60, size=(120, 160))
    tracker, trajectory, _ = track(items)
    error, length = ate(trajectory, items)
    assert error < 0.0025 * length
    true = np.stack([np.asarray(i.world_from_cam)[:3, 3] for i in items])
    scale = geometry.umeyama(trajectory.world_from_cam[:, :3, 3], true).scale
    ratios = []
    for index in trajectory.index[trajectory.keyframe]:
        keyframe, depth = tracker.keyframe(int(index)), items[int(index)].depth
        assert depth is not None
        u, v = (keyframe.points.astype(int) // 2).T
        use = keyframe.triangulated & (depth[v, u] > 0)
        ratios.append(scale / keyframe.inverse_depth[use] / depth[v, u][use])
    assert abs(np.median(np.concatenate(ratios)) - 1.0) < 0.03
    assert tracker.stats.warnings == []


@pytest.mark.slow
def test_a_map_that_few_points_hold_says_so() -> None:
    items = synthetic(frames=40, size=(120, 160), textureless=2)
    tracker, _, _ = track(items, TrackerConfig(area=160 * 120))
    assert any("few matches" in warning for warning in tracker.stats.warnings)
    assert tracker.stats.counts["matches of a pair of keyframes, median"] < 150


@pytest.mark.slow
def test_a_map_that_many_points_hold_does_not() -> None:
    tracker, *_ = tracked_room()
    assert tracker.stats.counts["matches of a pair of keyframes, median"] > 300
    assert not any("few matches" in warning for warning in tracker.stats.warnings)
