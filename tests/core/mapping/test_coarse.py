"""Keyframes that a live stream left no time for get the rest of their splats later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mapping import coarse
from mvsgs_core.mapping.coarse import LATER, CoarseKeyframes
from mvsgs_core.mapping.mapper import NONE_NOW, OnlineMapper
from mvsgs_core.stats import Stats
from tests.support.small_maps import CONFIG, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

LIVE = replace(CONFIG, realtime=True, iterations=20, refinement=60)
VIEWS = [rgbd_keyframe(7 * k, pose_on_arc(k / 4)) for k in range(3)]


def mapped(halvings: int) -> OnlineMapper:
    mapper = OnlineMapper(LIVE)
    for view in VIEWS:
        mapper.add_keyframe(view, halvings)
        for _ in range(3):
            mapper.step()
    return mapper


def test_what_was_mapped_coarsely_is_as_good_in_the_end_as_what_was_not() -> None:
    whole, hurried, left = mapped(0), mapped(1), mapped(1)
    assert len(hurried.coarse) == len(VIEWS)
    assert len(hurried.state) < 0.6 * len(whole.state)
    index = np.array([view.index for view in VIEWS])
    poses = np.stack([rgbd_keyframe(0, view.world_from_cam, unit=2.0).world_from_cam for view in VIEWS])
    hurried.correct(index, poses, np.full(3, 2.0))  # what is kept of their depth follows corrections
    while left.make_up(splats=False):
        pass
    for mapper in (whole, hurried):
        while mapper.make_up():
            pass
    assert hurried.log.counts[LATER] == len(VIEWS)
    assert hurried.iterations == left.iterations == whole.iterations == 60
    assert not len(hurried.coarse)
    for mapper in (whole, hurried, left):
        for done in range(mapper.refinement):
            mapper.refine(done, mapper.refinement)
    there = pose_on_arc(0.3)
    between, doubled = rgbd_keyframe(99, there), rgbd_keyframe(99, there, unit=2.0)
    assert score(hurried, doubled) > score(left, between) + 0.5
    assert score(hurried, doubled) > score(whole, between) - 1.0


def test_a_limit_holds_for_iterations_and_not_for_splats() -> None:
    mapper = mapped(1)
    before = mapper.iterations
    while mapper.make_up(limit=5):
        pass
    assert mapper.iterations == before + 5 + len(VIEWS) * (LIVE.refinement // 30)  # for what was added so late
    assert mapper.log.counts[LATER] == len(VIEWS)


def test_a_keyframe_without_splats_for_now_gets_them_all_later() -> None:
    mapper = mapped(NONE_NOW)
    assert set(mapper.state.anchors.tolist()) == {0}  # but in an empty map
    while mapper.make_up():
        pass
    assert set(mapper.state.anchors.tolist()) == {0, 7, 14}


def test_keyframes_without_splats_get_coarse_ones_first() -> None:
    mapper, coarse_at_once = mapped(NONE_NOW), mapped(1)
    before = mapper.iterations
    for _ in VIEWS[1:]:
        assert mapper.begin_late()
    assert not mapper.begin_late()
    assert mapper.iterations == before
    assert set(mapper.state.anchors.tolist()) == {0, 7, 14}
    assert 0.5 < len(mapper.state) / len(coarse_at_once.state) < 1.5
    assert LATER not in mapper.log.counts
    assert len(mapper.coarse) == len(VIEWS)  # the rest is still to come
    while mapper.make_up():
        pass
    assert mapper.log.counts[LATER] == len(VIEWS)


def test_what_a_rolling_shutter_took_gets_its_splats_from_the_image_without_it() -> None:
    mapper, photograph = OnlineMapper(LIVE), np.full_like(VIEWS[0].image, 255)
    moving = replace(VIEWS[0], photograph=photograph, velocity=np.full(6, 0.1), readout_time=0.02)
    mapper.add_keyframe(moving, 1)
    view, before = mapper.views[0], len(mapper.state)
    mapper.make_up()
    assert mapper.log.counts[LATER] == 1
    added = mapper.state.splats.sh[before:, 0].detach()
    assert len(added)
    assert float(added.min(dim=1).values.max()) < 1.6  # none of them is white, 1.77 in all colors
    assert view.readout_time == 0.02
    np.testing.assert_array_equal(view.image.numpy(), photograph)  # which is trained on as it was


def test_depth_is_kept_nearly_as_it_was_and_without_end_is_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    log = Stats()
    kept = CoarseKeyframes(log)
    doubtful = 1e6 * VIEWS[0].depth
    doubtful[0, 0] = np.nan
    view = replace(VIEWS[0], unfiltered=doubtful, photograph=VIEWS[0].image)
    kept.wait(replace(view, depth=1e6 * view.depth))
    kept.wait(replace(view, depth=np.zeros_like(view.depth), unfiltered=None))  # nothing to make splats of
    assert len(kept) == 1
    found = kept.next()
    assert found is not None
    np.testing.assert_allclose(found[0].depth, 1e6 * view.depth, rtol=1e-3)
    assert found[0].unfiltered is not None
    assert found[0].unfiltered[0, 0] == 0.0
    assert found[1] is not None
    np.testing.assert_array_equal(found[1], view.image)  # free of the shutter, which the one that is trained on is not
    assert not np.shares_memory(found[1], view.image), "a view of a message keeps all of the message"
    assert kept.next() is None
    kept.wait(view)
    size = kept.bytes
    monkeypatch.setattr(coarse, "MAX_BYTES", 2 * size)
    for other in range(1, 5):
        kept.wait(replace(view, index=other))
    newest = [kept.next() for _ in range(len(kept))]
    assert [found[0].index for found in newest if found is not None] == [3, 4]
    assert log.skipped == {"keyframes whose splats stay larger than their images ask for": 3}


def test_a_depth_without_end_costs_no_other_pixel() -> None:
    """That of a node that is no part of this program."""
    kept = CoarseKeyframes(Stats())
    endless = VIEWS[0].depth.copy()
    endless[0, :2] = np.inf, -np.inf
    expected = VIEWS[0].depth.copy()
    expected[0, :2] = 0.0
    for depth in (endless, np.zeros_like(endless)):
        kept.wait(replace(VIEWS[0], depth=depth, unfiltered=endless))
        found = kept.next()
        assert found is not None
        assert found[0].unfiltered is not None
        np.testing.assert_allclose(found[0].unfiltered, expected, rtol=1e-3)
    np.testing.assert_array_equal(found[0].depth, 0.0)
