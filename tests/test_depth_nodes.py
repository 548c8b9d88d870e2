"""Keyframe -> Depth -> FusedKeyframe through the nodes, on a rendered scene whose depth is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from msgs import Depth, FusedKeyframe, Keyframe, Poses, Request, TrackedFrame
from nodes import handlers, outputs
from nodes.coarse_depth import CoarseDepth
from nodes.depth_fusion import DepthFusion
from nodes.mvs import Mvs
from nodes.windowed import PATIENCE
from tests.support.keyframe_messages import SIZE, keyframe
from tests.support.plane_scene import FAR, NEAR, look, true_depth


def stereo(**changes: object) -> Mvs:
    return Mvs(Mvs.Config(area=SIZE[0] * SIZE[1], device="cpu", threads=1, **changes))  # type: ignore[arg-type]


def fusion(**changes: object) -> DepthFusion:
    return DepthFusion(DepthFusion.Config(device="cpu", threads=1, **changes))  # type: ignore[arg-type]


def test_contract() -> None:
    assert set(handlers(Mvs)) == {Keyframe, TrackedFrame, Poses, Request}
    assert set(outputs(Mvs)) == {Depth, TrackedFrame, Poses, Request}
    assert set(handlers(DepthFusion)) == {Depth, TrackedFrame, Poses, Request}
    assert set(outputs(DepthFusion)) == {FusedKeyframe, TrackedFrame, Poses, Request}
    assert set(outputs(CoarseDepth)) == {Depth, TrackedFrame, Poses, Request}


def test_frames_between_keyframes_pass_at_once() -> None:
    first = keyframe(0)
    frame = TrackedFrame(1, 0.1, first.image, first.intrinsics, 0, np.eye(4), 1.0)
    for node in (stereo(), fusion(), CoarseDepth()):
        (passed,) = node.on_tracked_frame(frame)
        assert passed is frame


def test_every_keyframe_becomes_one_view_in_order_and_is_right() -> None:
    mvs, depth_fusion = stereo(), fusion()
    depths = [d for i in range(7) for d in mvs.on_keyframe(keyframe(i))]
    assert [d.index for d in depths] == [0, 1, 2, 3, 4]  # two keyframes of lag
    depths += list(mvs.on_end())
    views = [v for d in depths for v in depth_fusion.on_depth(d)]
    assert [v.index for v in views] == [0, 1, 2, 3, 4]
    views += list(depth_fusion.on_end())
    assert [v.index for v in views] == list(range(7))
    view = views[3]
    truth = true_depth(view.world_from_cam, view.depth.shape)
    kept = view.depth > 0
    assert kept.mean() > 0.6
    assert np.mean(np.abs(view.depth - truth)[kept] < 0.02 * truth[kept]) > 0.95
    assert np.all(view.normals[~kept] == 0)
    np.testing.assert_allclose(np.linalg.norm(view.normals[kept], axis=-1), 1.0, atol=1e-5)
    assert mvs.stats.counts["keyframes"] == 7
    assert mvs.stats.skipped["hypotheses outside the range"] > 0


def test_before_a_map_is_saved_or_closed_no_keyframe_waits_and_the_next_are_matched_with_none_of_it() -> None:
    for asked, closes in (("pause", False), ("save_map", True), ("reset", True)):
        mvs, depth_fusion = stereo(), fusion()
        sent = [d for i in range(4) for d in mvs.on_keyframe(keyframe(i))]
        (*late, request) = mvs.on_request(Request(1, asked))
        assert [d.index for d in (*sent, *late)] == ([0, 1, 2, 3] if closes else [0, 1])
        fused = [v for d in (*sent, *late) for v in depth_fusion.on_depth(d)]
        (*late, passed) = depth_fusion.on_request(request)
        assert [v.index for v in (*fused, *late)] == ([0, 1, 2, 3] if closes else [])
        assert passed == Request(1, asked)
    before = mvs.stats.counts["neighbors"]
    list(mvs.on_keyframe(keyframe(5)))
    list(mvs.on_end())
    assert mvs.stats.counts["neighbors"] == before, "one alone has no neighbor"
    stopped = Request(2, "reset", problem="the disk is full")
    list(mvs.on_keyframe(keyframe(6)))
    assert list(mvs.on_request(stopped)) == [stopped]


def test_corrected_poses_move_what_is_stored() -> None:
    """Half-way through the tracker doubles the scale: depths computed before it must double with it."""
    mvs, depth_fusion = stereo(), fusion()
    depths = [d for i in range(6) for d in mvs.on_keyframe(keyframe(i))]
    views = [v for d in depths for v in depth_fusion.on_depth(d)]
    doubled = np.stack([look(0.08 * i) for i in range(6)])
    doubled[:, :3, 3] *= 2.0
    correction = Poses(1, np.arange(6), doubled, np.full(6, 2.0))
    assert list(mvs.on_poses(correction)) == [correction]  # passed on in its place
    assert list(depth_fusion.on_poses(correction)) == [correction]
    late = list(mvs.on_end())
    assert all(d.scale == 2.0 for d in late)
    views = [v for d in late for v in depth_fusion.on_depth(d)] + list(depth_fusion.on_end())
    assert views
    for view in views:
        assert view.scale == 2.0
        kept = view.depth > 0
        truth = 2.0 * true_depth(look(0.08 * view.index), view.depth.shape)
        assert kept.mean() > 0.3
        assert np.median(np.abs(view.depth - truth)[kept] / truth[kept]) < 0.02


def test_a_standing_camera_gives_no_depth_and_says_so() -> None:
    mvs, depth_fusion = stereo(), fusion()
    pose = look(0.0)
    depths = [d for i in range(4) for d in mvs.on_keyframe(keyframe(i, world_from_cam=pose))] + list(mvs.on_end())
    views = [v for d in depths for v in depth_fusion.on_depth(d)] + list(depth_fusion.on_end())
    assert [v.index for v in views] == [0, 1, 2, 3]
    assert not any((v.depth > 0).any() for v in views)
    assert any("no neighbor with a baseline" in w for w in mvs.stats.warnings)


def test_without_coarse_depth_the_neighbors_give_the_range() -> None:
    mvs = stereo()
    nothing = np.zeros((15, 20), dtype=np.float32)
    depths = [
        d for i in range(5) for d in mvs.on_keyframe(keyframe(i, inverse_depth=nothing) if i == 2 else keyframe(i))
    ]
    depth = next(d for d in depths if d.index == 2).depth
    truth = true_depth(look(0.16), depth.shape)
    assert np.mean(np.abs(depth - truth) < 0.05 * truth) > 0.7
    assert any("neighbors' grids" in w for w in mvs.stats.warnings)


def test_with_no_range_at_all_there_is_no_depth() -> None:
    mvs = stereo()
    nothing = np.zeros((15, 20), dtype=np.float32)
    depths = [d for i in range(3) for d in mvs.on_keyframe(keyframe(i, inverse_depth=nothing))]
    depths += list(mvs.on_end())
    assert len(depths) == 3
    assert not any((d.depth > 0).any() for d in depths)
    assert any("no depth range" in w for w in mvs.stats.warnings)


def test_segments_are_not_matched_with_each_other() -> None:
    mvs = stereo()
    depths = [d for i in range(3) for d in mvs.on_keyframe(keyframe(i))]
    depths += [d for i in range(3, 6) for d in mvs.on_keyframe(keyframe(i, segment=1))]
    depths += list(mvs.on_end())
    assert [(d.index, d.segment) for d in depths] == [(0, 0), (1, 0), (2, 0), (3, 1), (4, 1), (5, 1)]


def test_a_loop_that_joins_two_segments_leaves_the_keyframes_that_wait_in_the_window() -> None:
    """The tracker says that the segment is another's before it sends the first keyframe of the joined one."""
    mvs, depth_fusion = stereo(), fusion()
    before = [keyframe(i, segment=1) for i in range(4)]
    depths = [d for k in before for d in mvs.on_keyframe(k)]
    assert [(d.index, d.segment) for d in depths] == [(0, 1), (1, 1)]
    first = [replace(depths[0], index=i, timestamp=0.1 * i, world_from_cam=look(0.08 * i)) for i in range(4)]
    assert [v.index for d in first for v in depth_fusion.on_depth(d)] == [0, 1]
    poses, scale = np.stack([look(0.08 * i) for i in range(4)]), np.ones(4)
    joined = Poses(1, np.arange(4), poses, scale, segment=np.zeros(4, np.int32))
    later = Poses(2, np.arange(4), poses, scale)  # which says nothing of segments
    for node in (mvs, depth_fusion):
        assert [p for message in (joined, later) for p in node.on_poses(message)] == [joined, later]
    (late,) = mvs.on_keyframe(keyframe(4, segment=0))
    assert (late.index, late.segment) == (2, 0)
    (fused,) = depth_fusion.on_depth(replace(first[0], index=4, segment=0, world_from_cam=look(0.32)))
    assert (fused.index, fused.segment) == (2, 0)


def test_a_keyframe_that_a_join_overtook_is_of_the_joined_segment() -> None:
    mvs, depth_fusion = stereo(), fusion()
    joined = Poses(1, np.arange(1), look(0.0)[None], np.ones(1), segment=np.zeros(1, np.int32))
    for node in (mvs, depth_fusion):
        list(node.on_poses(joined))
    depths = [d for k in (keyframe(0, segment=1), keyframe(1), keyframe(2)) for d in mvs.on_keyframe(k)]
    assert [(d.index, d.segment) for d in depths] == [(0, 0)]
    (depth,) = depths
    sent = [replace(depth, index=i, segment=int(i == 0)) for i in range(3)]
    assert [(v.index, v.segment) for d in sent for v in depth_fusion.on_depth(d)] == [(0, 0)]


def test_coarse_depth_passes_the_grid_on() -> None:
    message = keyframe(0)
    (depth,) = CoarseDepth(CoarseDepth.Config(area=SIZE[0] * SIZE[1])).on_keyframe(message)
    truth = true_depth(message.world_from_cam, depth.depth.shape)
    known = depth.depth > 0
    assert known.mean() > 0.9
    assert np.median(np.abs(depth.depth - truth)[known] / truth[known]) < 0.02
    assert depth.depth[known].min() > 0.5 * NEAR
    assert depth.depth[known].max() < 2.0 * FAR


def test_passthrough_sends_depth_as_it_came() -> None:
    node = fusion(lag=0, window=0, refine=False, check=False, confidence=0.0)
    stamped = replace(keyframe(0), stamp=1_790_000_000_000_000_001)
    depth = next(iter(CoarseDepth(CoarseDepth.Config(area=SIZE[0] * SIZE[1])).on_keyframe(stamped)))
    (view,) = node.on_depth(depth)
    assert view.stamp == stamped.stamp
    np.testing.assert_array_equal(view.depth, depth.depth)
    np.testing.assert_array_equal(view.confidence, depth.confidence)


def test_what_the_filters_reject_is_sent_beside_the_filtered_depth() -> None:
    node = fusion(lag=0, window=0, refine=False, check=False, confidence=0.9)
    depth = next(iter(CoarseDepth(CoarseDepth.Config(area=SIZE[0] * SIZE[1])).on_keyframe(keyframe(0))))
    confidence = np.where(np.arange(depth.depth.shape[1]) < 20, 0.2, 1.0) * np.ones_like(depth.depth)
    (view,) = node.on_depth(replace(depth, confidence=confidence.astype(np.float32)))
    assert not view.depth[:, :20].any()
    np.testing.assert_array_equal(view.unfiltered, depth.depth)


def test_a_pixel_of_depth_or_confidence_that_is_not_finite_is_refused_alone() -> None:
    mvs = stereo()
    depths = [d for i in range(5) for d in mvs.on_keyframe(keyframe(i))] + list(mvs.on_end())
    sound, holed = fusion(), fusion()
    expected = [v for d in depths for v in sound.on_depth(d)] + list(sound.on_end())
    for depth in depths:
        depth.depth[50, 60], depth.confidence[70, 80], depth.confidence[71, 80] = np.inf, np.nan, np.inf
    found = [v for d in depths for v in holed.on_depth(d)] + list(holed.on_end())
    assert holed.stats.counts["refused_pixels"] == 3 * len(depths)
    assert any("not finite" in warning for warning in holed.stats.warnings)
    for with_holes, whole in zip(found, expected, strict=True):
        assert np.isfinite(with_holes.confidence).all()
        assert np.isfinite(with_holes.unfiltered).all()
        assert (with_holes.depth > 0).sum() > 0.95 * (whole.depth > 0).sum()
    assert (expected[2].depth > 0).mean() > 0.5


def test_exposure_and_vignetting_pass_through_and_a_correction_that_overtakes_them_holds() -> None:
    affine = np.eye(3, 4, dtype=np.float32)
    dark = np.array([-0.3, 0.0, 0.0], np.float32)
    mvs, depth_fusion = stereo(), fusion()
    sent = [keyframe(i, exposure=(1 + i) * affine, vignetting=dark) for i in range(6)]
    depths = [d for k in sent for d in mvs.on_keyframe(k)]
    assert [d.index for d in depths] == [0, 1, 2, 3]
    correction = Poses(
        1, np.array([2, 4]), np.stack([sent[2].world_from_cam, sent[4].world_from_cam]), np.ones(2),
        exposure=np.stack([20 * affine, 40 * affine]), vignetting=0.5 * dark,
    )  # fmt: skip
    views = [v for d in depths[:1] for v in depth_fusion.on_depth(d)]
    for node in (mvs, depth_fusion):
        assert list(node.on_poses(correction)) == [correction]
    depths = [*depths[1:], *mvs.on_end()]
    assert [d.exposure[0, 0] for d in depths] == [2, 3, 4, 40, 6]  # 2 was sent before it was corrected
    views += [v for d in depths for v in depth_fusion.on_depth(d)] + list(depth_fusion.on_end())
    assert [v.exposure[0, 0] for v in views] == [1, 2, 20, 4, 40, 6]
    assert all(np.array_equal(v.vignetting, 0.5 * dark) for v in views)
    (coarse,) = CoarseDepth(CoarseDepth.Config(area=SIZE[0] * SIZE[1])).on_keyframe(sent[3])
    np.testing.assert_array_equal(coarse.exposure, 4 * affine)


def test_a_photograph_passes_through_and_its_velocity_follows_the_maps_scale() -> None:
    velocity = np.arange(1.0, 7.0)
    mvs, depth_fusion = stereo(), fusion()
    sent = [keyframe(i) for i in range(6)]
    shutter = {"velocity": velocity, "readout_time": 0.02, "reads_columns": True}
    sent = [replace(k, photograph=k.image[::-1].copy(), **shutter) for k in sent]
    depths = [d for k in sent for d in mvs.on_keyframe(k)]
    assert all(np.array_equal(d.velocity, velocity) for d in depths)
    poses = np.stack([k.world_from_cam for k in sent])
    poses[:, :3, 3] *= 2.0
    correction = Poses(1, np.arange(6), poses, np.full(6, 2.0))
    for node in (mvs, depth_fusion):
        list(node.on_poses(correction))
    views = [v for d in [*depths, *mvs.on_end()] for v in depth_fusion.on_depth(d)] + list(depth_fusion.on_end())
    assert [v.index for v in views] == list(range(6))
    for view in views:
        assert view.scale == 2.0
        np.testing.assert_allclose(view.velocity, velocity * [2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
        np.testing.assert_array_equal(view.photograph, sent[view.index].image[::-1])
        assert view.readout_time == 0.02
        assert view.reads_columns


def test_a_velocity_that_is_known_better_reaches_keyframes_on_their_way() -> None:
    mvs, depth_fusion = stereo(), fusion()
    sent = [replace(k, photograph=k.image, velocity=np.ones(6), readout_time=0.02) for k in map(keyframe, range(4))]
    sent[3] = keyframe(3)  # sent before the shutter was known: the image is the photograph
    depths = [d for k in sent for d in mvs.on_keyframe(k)]
    poses = np.stack([k.world_from_cam for k in sent])
    better = np.full((4, 6), 5.0)
    better[1] = np.nan  # not known better
    correction = Poses(1, np.arange(4), poses, np.ones(4), velocity=better, readout_time=0.03, reads_columns=True)
    for node in (mvs, depth_fusion):
        list(node.on_poses(correction))
    views = [v for d in [*depths, *mvs.on_end()] for v in depth_fusion.on_depth(d)] + list(depth_fusion.on_end())
    found = [(None if v.velocity is None else v.velocity.tolist(), v.readout_time) for v in views]
    assert found == [([5.0] * 6, 0.03), ([1.0] * 6, 0.02), ([5.0] * 6, 0.03), ([5.0] * 6, 0.03)]
    assert [v.reads_columns for v in views] == [True, False, True, True]
    np.testing.assert_array_equal(views[3].photograph, sent[3].image)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_refused(bad: float) -> None:
    pose = look(0.0)
    pose[0, 3] = bad
    with pytest.raises(ValueError, match="not finite"):
        list(stereo().on_keyframe(keyframe(0, world_from_cam=pose)))


def ended(depth_fusion: DepthFusion, depths: list[Depth]) -> DepthFusion:
    for depth in depths:
        list(depth_fusion.on_depth(depth))
    list(depth_fusion.on_end())
    return depth_fusion


@pytest.mark.parametrize(("effort", "nearest"), [(1, 0.02), (2, 0.05)])
def test_less_effort_is_as_right_where_it_is_sure(effort: int, nearest: float) -> None:
    mvs = stereo(realtime=True)
    mvs._core.pace.choose = lambda: effort  # type: ignore[method-assign]
    depths = [d for i in range(5) for d in mvs.on_keyframe(keyframe(i))]
    depth = depths[2]
    truth = true_depth(depth.world_from_cam, depth.depth.shape)
    assert depth.effort == effort
    assert depth.depth.shape == SIZE
    sure = depth.confidence > 0.8
    assert sure.mean() > 0.2
    assert np.mean(np.abs(depth.depth - truth)[sure] < nearest * truth[sure]) > 0.95
    assert sum(n for name, n in mvs.stats.skipped.items() if name.startswith("effort")) == len(depths)


def test_where_there_is_no_time_for_stereo_the_trackers_depth_fills_holes_alone() -> None:
    mvs, depth_fusion = stereo(realtime=True), fusion(realtime=True)
    mvs._core.pace.choose = lambda: 3  # type: ignore[method-assign]
    depths = [d for i in range(7) for d in mvs.on_keyframe(keyframe(i))]
    views = [v for d in [*depths, *mvs.on_end()] for v in depth_fusion.on_depth(d)]
    assert [v.index for v in views] == [0, 1, 2, 3, 4]  # no keyframe is left out
    for view in views:
        assert view.unfiltered is not None
        assert not (view.depth > 0).any()
        truth = true_depth(view.world_from_cam, view.unfiltered.shape)
        known = view.unfiltered > 0
        assert known.mean() > 0.5
        assert np.median(np.abs(view.unfiltered - truth)[known] / truth[known]) < 0.05
        assert view.effort == 3


def test_a_live_keyframe_waits_for_later_ones_no_longer_than_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("nodes.windowed.time.monotonic", lambda: now[0])
    live, waiting = stereo(realtime=True), stereo()
    for node in (live, waiting):
        assert [d for i in range(2) for d in node.on_keyframe(keyframe(i))] == []
        assert node.on_idle() is None
    now[0] += 1.01 * PATIENCE
    assert [[d.index for d in live.on_idle() or ()] for _ in range(3)] == [[0], [1], []]
    assert live.on_idle() is None
    assert waiting.on_idle() is None  # a recording's map does not depend on the clock
    assert [d.index for i in range(2, 5) for d in live.on_keyframe(keyframe(i))] == [2]
    assert live.stats.counts["keyframes that waited for no later ones"] == 2


def test_effort_follows_what_waits() -> None:
    live = stereo(realtime=True)
    live.waiting = lambda kind: 50 if kind is Keyframe else 0
    efforts = [d.effort for i in range(7) for d in live.on_keyframe(keyframe(i))]
    assert efforts[0] == 1  # which tells what it costs
    assert all(effort >= 1 for effort in efforts[1:])
    live.waiting = lambda kind: 0
    live._core.pace._cost = 1e-4
    assert [d.effort for d in live.on_keyframe(keyframe(7))] == [0]


def test_depth_that_is_all_rejected_is_nothing_and_the_filters_are_named() -> None:
    """Neighbors that contradict each other, and a stereo that trusts none of them."""
    mvs = stereo()
    depths = [d for i in range(5) for d in mvs.on_keyframe(keyframe(i))] + list(mvs.on_end())
    assert "nothing" not in ended(fusion(), depths).stats.values
    random = np.random.default_rng(0)
    wrong = [
        replace(d, depth=random.uniform(1.0, 9.0, d.depth.shape).astype(np.float32), confidence=0.01 * d.confidence)
        for d in depths
    ]
    reason = ended(fusion(), wrong).stats.values["nothing"]
    assert reason.startswith("all depth of 5 keyframes was rejected")
    assert "confidence 100 %" in reason
    assert "consistency" in reason
    empty = [replace(d, depth=np.zeros_like(d.depth)) for d in depths]
    assert "none of 5 keyframes has a pixel with stereo depth" in ended(fusion(), empty).stats.values["nothing"]
    assert "nothing" not in ended(fusion(), []).stats.values  # the tracker says why
