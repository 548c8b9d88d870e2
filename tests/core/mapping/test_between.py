"""Frames between keyframes: they wait for their keyframe, go with it, and never cost a keyframe its image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.between import WAITING
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.schedule import Schedule
from tests.support.small_atlas import PLAIN, between, gain, view
from tests.support.tiny_scene import pose_on_arc


def mapped(count: int = 3, **changes: object) -> Atlas:
    atlas = Atlas(OnlineMapper(replace(PLAIN, **changes)))  # type: ignore[arg-type]
    for index in range(0, 2 * count, 2):
        atlas.add(view(index), 0)
    return atlas


def test_a_frame_waits_for_its_keyframe_and_is_taken_where_a_keyframe_or_the_end_comes() -> None:
    atlas = mapped(2)
    atlas.add_between(between(1, 0))
    atlas.add_between(between(5, 4))
    store = atlas.current.keyframes
    assert not store.between
    atlas.add(view(4), 0)
    assert [b.index for b in store.between] == [1, 5]
    assert [v.index for v in store.trained] == [0, 2, 4, 1, 5]
    atlas.add_between(between(3, 2))
    assert len(store.between) == 2
    atlas.finish()
    assert [b.index for b in store.between] == [1, 3, 5]
    assert [v.index for v in atlas.current.views] == [0, 2, 4]
    assert set(atlas.current.state.anchors.tolist()) <= {0, 2, 4}


def test_frames_whose_keyframe_never_comes_are_let_go_and_counted() -> None:
    atlas = mapped(1)
    for k in range(WAITING + 3):
        atlas.add_between(replace(between(3, 99), index=1000 + k))
    assert len(atlas.between.waiting) == WAITING
    assert atlas.current.log.skipped["frames between keyframes whose keyframe did not come"] == 3


def test_it_stands_where_it_was_seen_and_goes_with_its_keyframe() -> None:
    atlas = mapped()
    atlas.add_between(between(3, 2))
    atlas.finish()
    (found,) = atlas.current.keyframes.between
    np.testing.assert_allclose(found.world_from_cam, pose_on_arc(3 / 8), atol=1e-12)
    mapper = atlas.current
    np.testing.assert_allclose(found.refined_from_cam, mapper.frame.local(pose_on_arc(3 / 8)), atol=1e-12)
    moved = geometry.se3_exp(np.array([0.1, 0.2, -0.1, 0.05, 0.1, 0.0])) @ pose_on_arc(2 / 8)
    atlas.correct(np.array([2]), moved[None], np.array([1.5]))
    mapper.chosen(found)
    relative = geometry.inverse(pose_on_arc(2 / 8)) @ pose_on_arc(3 / 8)
    relative[:3, 3] *= 1.5
    np.testing.assert_allclose(found.refined_from_cam, mapper.frame.local(moved @ relative), atol=1e-12)
    step = geometry.se3_exp(np.array([0.01, 0.0, 0.02, 0.0, 0.03, 0.0]))
    keyframe = mapper.keyframes.of(2)
    assert keyframe is not None
    keyframe.pose_delta = step  # what the map makes of the keyframe's pose
    mapper.chosen(found)
    relative[:3, 3] /= mapper.frame.length
    np.testing.assert_allclose(found.refined_from_cam, keyframe.refined_from_cam @ relative, atol=1e-12)


def test_its_light_is_its_keyframes_and_what_changed_since() -> None:
    atlas = mapped()
    atlas.add_between(replace(between(3, 2), exposure=gain(1.1)))
    atlas.add_between(between(1, 0))
    atlas.finish()
    dark, plain = atlas.current.keyframes.between[1], atlas.current.keyframes.between[0]
    keyframe = atlas.current.keyframes.of(2)
    assert keyframe is not None
    assert keyframe.measured is not None
    expected = gain(1.1)[:, :3] @ keyframe.measured[:, :3]
    np.testing.assert_allclose(dark.measured[:, :3], expected, rtol=1e-6)
    assert plain.measured is None  # as its keyframe's
    atlas.correct(np.array([2]), pose_on_arc(2 / 8)[None], np.ones(1), None, gain(1.3)[None])
    atlas.current.chosen(dark)
    np.testing.assert_allclose(dark.measured[:, :3], gain(1.1)[:, :3] @ gain(1.3)[:, :3], rtol=1e-6)


def test_more_images_than_are_kept_cost_frames_between_before_keyframes() -> None:
    atlas = mapped(4, max_keyframes=5)
    for index in (1, 3, 5):
        atlas.add_between(between(index, index - 1))
    atlas.finish()
    store = atlas.current.keyframes
    assert [v.index for v in store.with_image] == [0, 2, 4, 6]
    assert len(store.between) == 1
    assert atlas.current.log.skipped["frames between keyframes beyond max_keyframes"] == 2


@pytest.mark.parametrize(
    "changes",
    [
        {"keyframe_from_cam": np.full((4, 4), np.nan)},
        {"keyframe_from_cam": 2.0 * np.eye(4)},
        {"scale": 0.0},
        {"intrinsics": np.array([np.inf, 1.0, 1.0, 1.0])},
        {"keyframe_from_cam": geometry.se3_exp(np.array([1e9, 0.0, 0.0, 0.0, 0.0, 0.0]))},
    ],
)
def test_what_no_camera_gives_is_refused(changes: dict[str, object]) -> None:
    atlas = mapped()
    atlas.add_between(replace(between(3, 2), **changes))  # type: ignore[arg-type]
    atlas.finish()
    assert not atlas.current.keyframes.between
    assert atlas.current.log.counts["refused_views"] == 1


def test_the_half_on_all_takes_its_turns_on_them_and_the_half_on_the_newest_does_not() -> None:
    schedule = Schedule(window=2, seed=0)
    schedule.add_budget(40)
    drawn = [schedule.next(4, 10) for _ in range(40)]
    assert set(drawn[::2]) == {2, 3}
    assert sorted(drawn[1::2]) == sorted(2 * list(range(10)))


def test_the_map_shows_a_frame_better_that_it_was_trained_on() -> None:
    """Of a part of the box that its keyframe hardly shows."""
    scores = {}
    for known in (False, True):
        atlas = mapped(2, iterations=20, refinement=60)
        if known:
            atlas.add_between(between(7, 2))
        atlas.finish()
        while atlas.step():
            pass
        while atlas.refine():
            pass
        target = view(7)
        atlas.current.add_keyframe(replace(target, depth=np.zeros_like(target.depth), unfiltered=None))
        seen = atlas.current.keyframes.of(7)
        assert seen is not None
        scores[known] = psnr(atlas.current.render(seen).color.clamp(0.0, 1.0).numpy(), seen.target.numpy())
    assert scores[True] > scores[False] + 0.3
