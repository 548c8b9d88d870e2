"""A camera is followed from frame to frame: its pose against true keyframes, frames that rest, frames that are lost."""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from tests.support.true_maps import (
    exact_matches,
    image,
    item,
    matcher,
    pose_error,
    seen_at,
    shuffled,
    true_graph,
    true_pose,
)

SLIT = slice(107, 213)  # columns of an image: a third


def front_end(*keyframes: int) -> FrontEnd:
    """On a true map, its first keyframe the reference."""
    made = FrontEnd(true_graph(*keyframes), matcher(), FrontEndConfig(), 1)
    made.refer_to(image(keyframes[0]))
    return made


def at(number: int, seconds: float) -> TrackingImage:
    view = image(number)
    view.timestamp = seconds
    return view


def test_a_pose_moves_with_its_reference() -> None:
    """As a loop moves it, and a part of the map is joined to one of another unit."""
    made = front_end(0)
    step = made.follow(image(4), with_pose=True)
    assert step.pose_in(made.graph) is step.pose
    moved = geometry.se3_exp(np.array([0.5, -0.3, 0.2, 0.1, 0.4, -0.2]))
    keyframe = made.graph.keyframes[0]
    keyframe.cam_from_world = keyframe.cam_from_world @ moved
    made.graph.rescale([0], 3.0)
    expected = geometry.scaled(step.pose @ moved, 3.0)
    np.testing.assert_allclose(step.pose_in(made.graph), expected, atol=1e-9)
    again = made.follow(image(4), with_pose=True)
    assert again.still, "it is the same frame, as it was found before"
    np.testing.assert_allclose(again.pose_in(made.graph), expected, atol=1e-9)


def test_poses_are_found_frame_by_frame() -> None:
    made = front_end(0)
    steps = {number: made.follow(image(number), with_pose=True) for number in (2, 4, 6)}
    for number, step in steps.items():
        distance, angle = pose_error(step.pose, true_pose(number))
        assert distance < 0.005, "meters"
        assert angle < 0.005
        assert step.reference == 0
        assert step.fraction > 0.7
        assert not made.is_lost(step)
        expected, _ = made.graph.predict_pose(0, true_pose(number))
        found = np.linalg.norm(expected - step.matches.target, axis=1)[step.matches.alive]
        assert np.median(found) < 0.3, "pixels"
    assert steps[2].flow < steps[4].flow < steps[6].flow
    assert made.pose is not None
    np.testing.assert_array_equal(made.pose, steps[6].pose)


def test_points_are_propagated_from_frame_to_frame() -> None:
    """Step by step a point is followed to where a search from the reference alone does not find it."""
    made = front_end(0)
    for number in range(3, 16, 3):
        step = made.follow(image(number), with_pose=False)
    assert step.localization is None
    assert step.flow > 30.0, "pixels"
    expected, _ = made.graph.predict_pose(0, true_pose(15))
    assert np.median(np.linalg.norm(expected - made.propagated, axis=1)[step.matches.alive]) < 0.5


def test_a_camera_that_rests_is_seen_to() -> None:
    made = front_end(0)
    first = made.follow(image(2), with_pose=True)
    assert not first.still
    again = made.follow(image(2, index=3), with_pose=True)
    assert again.still
    assert again.matches is first.matches
    np.testing.assert_array_equal(again.pose, first.pose)
    assert made.follow(image(2, index=4), with_pose=False).localization is None


def test_a_slow_camera_has_a_pose_of_its_own_in_every_frame() -> None:
    """As of the frame before, poses would be a staircase."""
    made, before = front_end(0), true_pose(0)
    for index in range(1, 9):
        frame, true = seen_at(0.04 * index, index)
        step = made.follow(frame, with_pose=True)
        assert not step.still, index
        moved = pose_error(before, true)[0]
        assert pose_error(step.pose, true)[0] < 0.5 * moved
        assert step.flow < index * 0.001 * frame.longer_side
        before = true


def test_the_noise_of_a_sensor_is_no_motion() -> None:
    """Nor what a camera makes of it that compresses its images."""
    made, random = front_end(0), np.random.default_rng(0)
    made.follow(image(2), with_pose=True)
    for index in range(3, 9):
        noisy = np.clip(item(2).image + random.normal(0.0, 4.0, (240, 320, 3)), 0, 255).astype(np.uint8)
        _, packed = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 80])
        frame = TrackingImage.of(index, index / 20.0, cv2.imdecode(packed, cv2.IMREAD_COLOR), (240, 320), False)
        assert made.follow(frame, with_pose=True).still


def test_a_light_that_is_switched_on_is_no_rest() -> None:
    made = front_end(0)
    made.follow(image(2), with_pose=True)
    brighter = np.clip(item(2).image.astype(int) + 20, 0, 255).astype(np.uint8)
    assert not made.follow(TrackingImage.of(3, 0.15, brighter, (240, 320), False), with_pose=True).still


def test_a_covered_lens_does_not_rest() -> None:
    made = front_end(0)
    made.follow(image(2), with_pose=True)
    black = TrackingImage.of(3, 0.15, np.zeros((240, 320, 3), np.uint8), (240, 320), False)
    step = made.follow(black, with_pose=True)
    assert not step.still
    assert made.is_lost(step)


def test_a_lost_frame_leaves_things_as_they_were() -> None:
    made = front_end(0)
    made.follow(image(2), with_pose=True)
    last, points, pose = made.last, made.propagated, made.pose
    step = made.follow(shuffled(2, 3), with_pose=True)
    assert made.is_lost(step)
    assert made.last is last
    assert made.propagated is points
    assert made.pose is pose
    assert not made.is_lost(made.follow(image(4), with_pose=True)), "it goes on from the last frame that was followed"


def test_a_lost_frame_leaves_the_first_keyframe_without_a_velocity_until_one_is_followed() -> None:
    """It is what the rolling shutter of that keyframe is corrected by."""
    made, noise = front_end(0), np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    assert made.reference is not None
    bad = TrackingImage.of(2, 0.1, noise, made.reference.size, False)
    assert made.is_lost(made.follow(bad, with_pose=False))
    assert made.reference.velocity is None
    followed = at(4, 0.2)
    assert not made.is_lost(made.follow(followed, with_pose=False))
    assert made.reference.velocity is followed.velocity
    assert followed.velocity is not None


def test_a_frame_is_lost_by_too_few_points_or_a_pose_that_they_do_not_agree_on() -> None:
    made = front_end(0)
    step = made.follow(image(2), with_pose=True)
    assert step.localization is not None
    for localization in (replace(step.localization, inliers=0.4), replace(step.localization, failure="singular")):
        assert made.is_lost(replace(step, localization=localization))
    assert made.is_lost(replace(step, fraction=0.1))
    few = np.where(np.cumsum(step.matches.alive) < 30, step.matches.weight, 0.0)
    assert made.is_lost(replace(step, matches=replace(step.matches, weight=few)))
    assert not made.is_lost(step)


def test_tracking_resumes_from_another_keyframe() -> None:
    made = front_end(0, 12)
    for number in (4, 8):
        made.follow(image(number), with_pose=True)
    made.resume(image(12), image(8), exact_matches(made.graph, 12, true_pose(8)), true_pose(8))
    assert made.reference is not None
    assert made.reference.index == 12
    step = made.follow(image(6), with_pose=True)
    assert step.reference == 12
    assert step.fraction > 0.7
    assert max(pose_error(step.pose, true_pose(6))) < 0.005


def test_an_image_that_is_shown_again_rests_after_it_was_found_in_the_map() -> None:
    made = front_end(0, 6, 12)
    made.resume(image(12), image(8), exact_matches(made.graph, 12, true_pose(8)), true_pose(8))
    step = made.follow(replace(image(8), index=9), with_pose=True)
    assert (step.still, step.reference) == (True, 12)


def test_the_images_velocity_is_that_of_the_flow() -> None:
    made = front_end(0)
    made.refer_to(at(0, 1.0))
    later = at(2, 1.1)
    step = made.follow(later, with_pose=True)
    assert later.velocity is not None
    assert later.velocity.shape == (30, 40, 2)
    moved = (step.matches.target - made.graph.keyframes[0].points)[step.matches.alive]
    np.testing.assert_allclose(np.median(later.velocity, axis=(0, 1)), np.median(moved, axis=0) / 0.1, atol=3.0)
    assert made.reference is not None
    assert made.reference.velocity is later.velocity, "it has none of its own yet"
    slow = at(4, 2.0)
    made.follow(slow, with_pose=True)
    assert slow.velocity is None, "a second later nothing is known of it"


@functools.cache
def slow() -> Synthetic:
    """The same round at a pixel a frame."""
    return Synthetic(frames=900, loop=True, threads=1)


def through_a_slit(number: int, masked: bool, beside: int = 0) -> TrackingImage:
    """A slow frame whose outer two thirds show nothing, as those of an upright video in a wide one."""
    pixels, mask = np.full((240, 320, 3), beside, np.uint8), np.zeros((240, 320), bool)
    pixels[:, SLIT], mask[:, SLIT] = slow()[number].image[:, SLIT], True
    return TrackingImage.of(number, number / 20.0, pixels, (240, 320), False, mask=mask if masked else None)


@pytest.mark.parametrize("masked", [False, True])
def test_a_camera_that_moves_between_black_borders_does_not_rest(masked: bool) -> None:
    frame, depth, seen = through_a_slit(0, masked), slow()[0].depth, through_a_slit
    assert depth is not None
    inverse_depth = 1.0 / depth[*frame.cells.points.astype(int).T[::-1]].astype(np.float64)
    graph = KeyframeGraph(slow().intrinsics)
    true = [geometry.inverse(np.asarray(slow()[number].world_from_cam)) for number in range(9)]
    graph.add(Keyframe(frame, true[0], inverse_depth, 1e3 / inverse_depth**2, 0))
    made = FrontEnd(graph, matcher(), FrontEndConfig(), 1)
    made.refer_to(frame)
    for number in range(1, 9):
        step = made.follow(seen(number, masked), with_pose=True)
        assert not step.still, number
        assert pose_error(step.pose, true[number])[0] < 0.005, "meters"
    assert made.follow(replace(seen(8, masked), index=9), with_pose=True).still


def test_what_changes_where_it_is_masked_is_no_motion() -> None:
    """A robot's own arm, a clock in the image."""
    made = front_end(0)
    made.refer_to(through_a_slit(0, masked=True))
    made.follow(through_a_slit(6, masked=True), with_pose=False)
    assert made.follow(replace(through_a_slit(6, masked=True, beside=60), index=7), with_pose=False).still


def test_an_image_that_is_shown_again_rests_right_after_its_keyframe_too() -> None:
    """As in a video of 15 frames a second that is shown at 30: no velocity and no pose are its own."""
    made = front_end(0)
    noise = np.random.default_rng(0).normal(0.0, 0.5, (240, 320))
    again = at(0, 1.1)
    again = replace(again, index=1, gray=np.clip(again.gray + noise, 0, 255).round().astype(np.uint8))
    made.refer_to(at(0, 1.0))
    step = made.follow(again, with_pose=True)
    assert (step.still, step.reference) == (True, 0)
    seen = step.matches.alive
    np.testing.assert_array_equal(step.matches.target[seen], made.graph.keyframes[0].points[seen])
    assert again.velocity is None
    later = at(2, 1.2)
    assert not made.follow(later, with_pose=True).still
    assert later.velocity is not None
