"""The map is trained on photographs as a rolling shutter took them, by renders as it saw them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.between import FrameBetween
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_maps import CONFIG, mapped, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

READOUT_TIME = 0.02
TIMES = (0.0, 0.33, 0.66, 1.0)


def photographed(
    index: int, t: float, velocity: np.ndarray, unit: float = 1.0, reads_columns: bool = False
) -> RGBDKeyframe:
    """A keyframe whose photograph's rows, or columns, were each seen from where the camera was then."""
    still = rgbd_keyframe(index, pose_on_arc(t), unit=unit)
    photograph, axis = still.image.copy(), int(reads_columns)
    for line in range(photograph.shape[axis]):
        moved = geometry.se3_exp(velocity * READOUT_TIME * (line / photograph.shape[axis] - 0.5))
        at = (slice(None), line) if reads_columns else line
        photograph[at] = rgbd_keyframe(index, pose_on_arc(t) @ moved).image[at]
    scaled = velocity * ([unit] * 3 + [1.0] * 3)
    return replace(
        still, photograph=photograph, velocity=scaled, readout_time=READOUT_TIME, reads_columns=reads_columns
    )


def shaking(unit: float = 1.0, reads_columns: bool = False) -> list[RGBDKeyframe]:
    """Views of a camera that moves by 3 to 5 pixels within each."""
    speed = np.random.default_rng(0).choice([-1.0, 1.0], (len(TIMES), 6)) * [4.0, 4.0, 2.0, 2.0, 2.0, 2.0]
    return [photographed(5 * k, t, speed[k], unit, reads_columns) for k, t in enumerate(TIMES)]


@pytest.mark.parametrize(("unit", "reads_columns"), [(1.0, False), (50.0, False), (1.0, True)])
def test_photographs_with_their_shutter_give_the_map_of_still_ones(unit: float, reads_columns: bool) -> None:
    """Nearly as good, for the shutter is rendered to first order; photographs without it in the render are far off."""
    views = shaking(unit, reads_columns)
    between = rgbd_keyframe(99, pose_on_arc(0.5), unit=unit)
    by_shutter = score(mapped(views), between)
    still = score(mapped([replace(v, photograph=None) for v in views]), between)
    ignored = score(mapped([replace(v, readout_time=0.0) for v in views]), between)
    assert by_shutter - ignored > 1.5 * (still - by_shutter), (by_shutter, still, ignored)
    assert by_shutter > ignored + 3.0, (by_shutter, still, ignored)


def test_the_keyframe_is_shown_as_the_shutter_saw_it() -> None:
    """The self check and the previews compare like with like."""
    mapper = mapped(shaking())
    found = mapper.self_check()
    assert found is not None
    for view in mapper.views:
        view.readout_time = 0.0
    without = mapper.self_check()
    assert without is not None
    assert found.psnr > without.psnr + 2.0


def test_the_velocity_follows_the_maps_scale() -> None:
    view = shaking()[0]
    mapper = OnlineMapper(CONFIG)
    assert view.velocity is not None
    mapper.correct(np.array([0]), view.world_from_cam[None], np.array([2.0]))  # it overtakes the keyframe
    mapper.add_keyframe(view)
    (trained,) = mapper.views
    np.testing.assert_allclose(trained.velocity[:3], 2.0 * view.velocity[:3] / mapper.frame.length)
    np.testing.assert_array_equal(trained.velocity[3:], view.velocity[3:])
    mapper.correct(np.array([0]), view.world_from_cam[None], np.array([3.0]))
    np.testing.assert_allclose(trained.velocity[:3], 3.0 * view.velocity[:3] / mapper.frame.length)


def test_a_velocity_that_is_known_better_replaces_the_first() -> None:
    views = shaking()[:2]
    mapper = mapped([replace(views[0], photograph=None), views[1]])
    better = np.stack([np.full(6, 2.0), np.arange(1.0, 7.0)])
    mapper.move(np.array([0, 5]), better, 0.03, reads_columns=True)
    assert mapper.views[0].readout is None  # its image has no shutter in it
    assert mapper.views[1].reads_columns
    in_unit = better[1] / np.repeat([mapper.frame.length, 1.0], 3)
    np.testing.assert_allclose(mapper.views[1].readout, 0.03 * in_unit)
    mapper.move(np.array([5]), np.full((1, 6), np.nan), 0.01)
    np.testing.assert_allclose(mapper.views[1].readout, 0.03 * in_unit)


def test_where_there_is_no_rolling_shutter_after_all_no_keyframe_has_one() -> None:
    """Those of a map that is gone on with neither, whose velocities this stream does not tell."""
    views = shaking()
    mapper = mapped(views)
    assert all(view.readout is not None for view in mapper.views)
    index = np.array([view.index for view in views])
    velocity = np.full((len(views), 6), np.nan)
    velocity[0] = 1.0
    mapper.move(index, velocity, 0.0)
    assert all(view.readout is None for view in mapper.views)


def test_keyframes_sent_before_the_readout_time_was_known_get_it_when_it_is() -> None:
    """What was trained without the shutter is then refined with it."""
    views = shaking()
    unknown = [replace(v, image=v.photograph, photograph=None, velocity=None, readout_time=0.0) for v in views]
    mapper, never = mapped(unknown), mapped(unknown)
    assert all(view.readout is None for view in mapper.views)
    mapper.move(np.array([view.index for view in views]), np.stack([view.velocity for view in views]), READOUT_TIME)
    for view, sent in zip(mapper.views, views):
        assert sent.velocity is not None
        expected = READOUT_TIME * sent.velocity / np.repeat([mapper.frame.length, 1.0], 3)
        np.testing.assert_allclose(view.readout, expected)
    for done in range(40):
        mapper.refine(done, 40)
        never.refine(done, 40)
    between = rgbd_keyframe(99, pose_on_arc(0.5))
    assert score(mapper, between) > score(never, between) + 2.0


def test_an_image_that_is_free_of_the_shutter_stays_so() -> None:
    """Its photograph was refused, so that what it was rectified by is not known."""
    mapper = OnlineMapper(CONFIG)
    mapper.add_keyframe(replace(shaking()[0], readout_time=float("nan")))
    mapper.move(np.array([0]), np.ones((1, 6)), READOUT_TIME)
    assert mapper.views[0].readout is None


def test_a_view_before_the_unit_is_known_gets_its_velocity_in_it() -> None:
    first, second = shaking()[:2]
    mapper = OnlineMapper(CONFIG)
    mapper.add_keyframe(replace(first, depth=np.zeros_like(first.depth), normals=None))
    mapper.add_keyframe(second)
    assert mapper.frame.unit is not None
    assert first.velocity is not None
    np.testing.assert_allclose(mapper.views[0].velocity[:3], first.velocity[:3] / mapper.frame.unit)


def beside(keyframe: RGBDKeyframe, **changes: object) -> FrameBetween:
    """A frame beside the keyframe, which moved as that did."""
    relative = geometry.se3_exp(np.array([0.01, 0.0, 0.0, 0.0, 0.02, 0.0]))
    found = FrameBetween(
        99, 9.9, keyframe.image, keyframe.intrinsics, keyframe.index, relative, keyframe.scale,
        velocity=keyframe.velocity, readout_time=keyframe.readout_time,
    )  # fmt: skip
    return replace(found, **changes)  # type: ignore[arg-type]


def test_a_frame_between_keyframes_is_rendered_as_its_shutter_saw_it() -> None:
    """Its velocity follows the scale of its keyframe, its readout time what the tracker says of the camera later."""
    keyframe = shaking(50.0)[0]
    mapper = mapped([keyframe])
    assert mapper.add_between(beside(keyframe))
    (view,) = mapper.keyframes.between
    expected = READOUT_TIME * keyframe.velocity / np.repeat([mapper.frame.length, 1.0], 3)
    np.testing.assert_allclose(view.readout, expected)
    mapper.correct(np.array([0]), keyframe.world_from_cam[None], np.array([3.0]))
    mapper.move(np.array([7]), np.ones((1, 6)), 0.03, reads_columns=True)
    mapper.chosen(view)
    assert view.reads_columns
    np.testing.assert_allclose(view.readout, 1.5 * expected * np.repeat([3.0, 1.0], 3))


def test_a_frame_between_keyframes_without_a_velocity_stays_as_it_is() -> None:
    keyframe = shaking()[0]
    mapper = mapped([keyframe])
    mapper.add_between(beside(keyframe, velocity=None, readout_time=0.0))
    mapper.move(np.array([0]), np.ones((1, 6)), 0.03)
    assert mapper.keyframes.between[0].readout is None


@pytest.mark.parametrize(
    "change", [{"velocity": np.full(6, np.inf)}, {"readout_time": -0.5}, {"readout_time": float("nan")}]
)
def test_a_shutter_of_a_frame_between_that_no_camera_has_is_left_out(change: dict) -> None:
    keyframe = shaking()[0]
    mapper = mapped([keyframe])
    mapper.add_between(beside(keyframe, **change))
    assert mapper.log.counts["refused_photographs"] == 1
    assert mapper.keyframes.between[0].readout is None


@pytest.mark.parametrize(
    "change",
    [
        {"photograph": np.zeros((4, 4, 3), np.uint8)}, {"velocity": None}, {"velocity": np.full(6, np.nan)},
        {"readout_time": -0.5}, {"readout_time": float("nan")}, {"readout_time": 5.0},
    ],
)  # fmt: skip
def test_a_photograph_that_says_nothing_is_left_out(change: dict) -> None:
    view = replace(shaking()[0], **change)
    mapper = OnlineMapper(CONFIG)
    mapper.add_keyframe(view)
    assert mapper.log.counts["refused_photographs"] == 1
    assert mapper.views[0].readout is None
    np.testing.assert_array_equal(mapper.views[0].image.numpy(), view.image)


@pytest.mark.parametrize("readout_time", [-0.5, 0.5, float("nan")])
def test_a_corrected_readout_time_that_no_camera_has_is_refused_and_counted(readout_time: float) -> None:
    atlas = Atlas(OnlineMapper(CONFIG))
    for view in shaking():
        atlas.add(view, 0)
    before = [(view.readout_time, view.velocity.copy()) for view in atlas.current.views]
    index = np.array([view.index for view in atlas.current.views])
    poses = np.stack([view.world_from_cam for view in atlas.current.views])
    atlas.correct(index, poses, np.ones(len(index)), velocity=np.ones((len(index), 6)), readout_time=readout_time)
    for (time, velocity), view in zip(before, atlas.current.views):
        assert view.readout_time == time
        np.testing.assert_array_equal(view.velocity, velocity)
    assert any("readout time" in warning for warning in atlas.current.log.warnings)
