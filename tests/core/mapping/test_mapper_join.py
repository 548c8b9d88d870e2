"""Two maps of one stream become one: nothing that a keyframe sees changes, and training goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core import geometry
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.map_state import PARAMETERS
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.pruning import JUDGES, bound
from mvsgs_core.mapping.trainer import Trainer
from mvsgs_core.photometry import compose
from mvsgs_core.rasterizer.rasterize import Render
from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats
from tests.support.small_atlas import gain
from tests.support.small_atlas import view as keyframe
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (24, 32)
CONFIG = MapperConfig(
    iterations=6,
    window=2,
    max_keyframes=5,
    sh_degree=1,
    device="cpu",
    training=TrainingConfig(refine_poses=True, pose_visits=1),
)
AWAY = geometry.se3_exp(np.array([0.0, 0.0, -60.0, 0.0, np.pi, 0.0]))  # behind the back of the other's cameras
# As if begun anew, elsewhere. Splats of equal depth may swap by rounding in another frame, which shows in a few pixels
# by up to 0.02: in this one none do.
OTHER_FRAME = geometry.se3_exp(np.array([300.0, -7.0, 20.0, 0.5, 0.1, 0.1]))


def mapped(indices: list[int], frame: np.ndarray, unit: float, corrections: dict) -> OnlineMapper:
    mapper = OnlineMapper(CONFIG, corrections=corrections)
    for index in indices:
        view = rgbd_keyframe(index, pose_on_arc(index / 8), SIZE, unit=unit)
        mapper.add_keyframe(
            replace(view, world_from_cam=frame @ view.world_from_cam, exposure=gain(1.0 + 0.02 * index))
        )
    while mapper.step():
        pass
    return mapper


def on_black(mapper: OnlineMapper, view: TrainingView) -> Render:
    """Without the background, which is the mean color of all keyframes and so changes with a join."""
    trainer = Trainer(mapper.config, mapper.state, Stats(), mapper.photometry)
    return trainer.render(view, mapper.median_depth)


def test_every_keyframe_sees_after_the_join_what_it_saw_before() -> None:
    corrections: dict = {}
    first, second = mapped([0, 1, 6], np.eye(4), 1.0, corrections), mapped([3, 4], OTHER_FRAME, 0.4, corrections)
    seen = {view.index: (part, on_black(part, view)) for part in (first, second) for view in part.views}
    moments = torch.cat([part.state.first["opacity_logits"] for part in (first, second)])
    ages = torch.cat([part.state.steps for part in (first, second)])
    exposures = {view.index: view.exposure.clone() for part in (first, second) for view in part.views}
    iterations = first.iterations + second.iterations
    assert first.frame.origin is not None
    assert first.frame.unit is not None
    assert second.frame.unit is not None
    origin = first.frame.origin.copy()

    poses = np.stack([AWAY @ pose_on_arc(index / 8) for index in (3, 4)])
    second.correct(np.array([3, 4]), poses, np.full(2, 2.5))
    first.join(second)

    assert [view.index for view in first.views] == [0, 1, 3, 4, 6]
    assert [view.fixed for view in first.views] == [True, False, False, False, False]
    np.testing.assert_array_equal(first.frame.origin, origin)
    assert first.iterations == iterations == 30
    for view in first.views:
        before, after = seen[view.index][1], on_black(first, view)
        assert before.opacity.mean() > 0.5
        torch.testing.assert_close(after.color, before.color, atol=2e-3, rtol=0)
        ratio = second.frame.unit / first.frame.unit * 2.5 if view.index in (3, 4) else 1.0
        torch.testing.assert_close(after.depth, before.depth * ratio, atol=0.02, rtol=0)
        torch.testing.assert_close(view.exposure, exposures[view.index])
    torch.testing.assert_close(first.state.first["opacity_logits"], moments)
    assert torch.equal(first.state.steps, ages)
    for name in PARAMETERS:
        assert first.state.first[name].shape == getattr(first.state.splats, name).shape

    first.add_keyframe(rgbd_keyframe(7, pose_on_arc(7 / 8), SIZE))  # beyond the number of images that are kept
    while first.step():
        pass
    assert sum(view.has_image for view in first.views) == 5
    assert all(bool(torch.isfinite(value).all()) for value in first.state.detached().tensors().values())


def test_of_two_gauges_of_exposure_the_join_leaves_one() -> None:
    """As poses do: the tracker says the later part's exposures anew, against the earlier part's mean camera."""
    atlas, own, gauge = Atlas(OnlineMapper(CONFIG)), {}, gain(0.7)
    for index in (0, 1, 3, 4):
        segment = int(index > 2)
        own[index] = gain(1.1) if index % 2 else gain(0.9)
        told = compose(own[index], gauge) if segment else own[index]
        shown = rgbd_keyframe(index, pose_on_arc(index / 8), SIZE)
        light = (shown.image / 255.0 @ own[index][:, :3].T).clip(0.0, 1.0)
        image = np.round(255.0 * light).astype(np.uint8)
        atlas.add(replace(shown, image=image, exposure=told.astype(np.float32)), segment)
    while atlas.current.step():
        pass
    seen = {view.index: on_black(part, view).color for part in atlas.parts.values() for view in part.views}
    later = atlas.current.state.splats.sh.detach().clone()
    joined = np.zeros(4, np.int32)
    poses = np.stack([AWAY @ pose_on_arc(index / 8) if index > 2 else pose_on_arc(index / 8) for index in own])
    atlas.correct(np.array(list(own)), poses, np.ones(4), joined, np.stack(list(own.values())))
    assert len(atlas.parts) == 1
    mapper = atlas.current
    for view in mapper.views:
        np.testing.assert_array_equal(view.measured, own[view.index])
        torch.testing.assert_close(on_black(mapper, view).color, seen[view.index], atol=5e-3, rtol=0)
    # the same wall, so the same colors: of the later part they were those of another mean camera
    mean = [0.5 + C0 * sh[:, 0].mean(dim=0) for sh in (mapper.state.splats.sh[-len(later) :], later)]
    torch.testing.assert_close(mean[0], mean[1] * torch.tensor([0.7, 0.7, 0.63]), atol=0.01, rtol=0)


def test_maps_that_have_no_depth_or_no_keyframe_yet_are_joined() -> None:
    corrections: dict = {}
    empty, blind = OnlineMapper(CONFIG, corrections=corrections), OnlineMapper(CONFIG, corrections=corrections)
    blind.add_keyframe(replace(rgbd_keyframe(0, pose_on_arc(0.0), SIZE), depth=np.zeros(SIZE, np.float32)))
    full = mapped([1, 2], np.eye(4), 3.0, corrections)
    seen = [on_black(full, view).color for view in full.views]
    blind.join(empty)
    blind.join(full)
    empty.join(blind)
    assert [view.index for view in empty.views] == [0, 1, 2]
    assert (empty.frame.unit, len(empty.state)) == (full.frame.unit, len(full.state))
    for view, before in zip(empty.views[1:], seen):
        torch.testing.assert_close(on_black(empty, view).color, before, atol=2e-3, rtol=0)
    np.testing.assert_allclose(empty.snapshot().world_from_cam[0], pose_on_arc(0.0), atol=1e-12)


def test_images_of_a_part_that_was_left_rest_on_disk() -> None:
    atlas = Atlas(OnlineMapper(CONFIG))
    for index in range(6):
        atlas.add(rgbd_keyframe(index, pose_on_arc(index / 8), SIZE), segment=index // 3)
    left, current = atlas.parts[0], atlas.parts[1]
    assert [view.image_on_disk for view in left.views] == [True, False, False]  # the window's stay
    assert not any(view.image_on_disk for view in current.views)
    while atlas.current.step():
        pass
    atlas.add(rgbd_keyframe(6, pose_on_arc(6 / 8), SIZE), segment=0)
    assert [view.image_on_disk for view in current.views] == [True, False, False]


def test_a_join_keeps_to_max_splats_by_what_the_images_miss_least() -> None:
    free = replace(CONFIG, iterations=0, window=8, max_keyframes=8)
    most = 40
    full = replace(free, density_control=DensityControlConfig(max_splats=most))
    corrections: dict = {}

    def part(config: MapperConfig, *indices: int) -> OnlineMapper:
        mapper = OnlineMapper(config, corrections=corrections)
        for index in indices:
            mapper.add_keyframe(keyframe(index))
        return mapper

    def error(mapper: OnlineMapper) -> float:
        return sum(float((mapper.render(known).color - known.target).square().sum()) for known in mapper.views)

    one, other = part(full, 0, 2), part(full, 4, 6)
    assert len(one.state) == len(other.state) == most
    refused = one.log.counts["refused_splats"]
    whole = part(free, 0, 2)
    whole.state.become(one.state.tensors())
    whole.join(part(full, 4, 6))
    one.join(other)
    assert (len(one.state), len(whole.state)) == (most, 2 * most)
    assert one.log.counts["refused_splats"] == refused + most
    assert any("joined" in text and f"max_splats={most}" in text for text in one.log.warnings)
    first = one.state.tensors()
    whole.state.keep(torch.arange(2 * most) < most)  # as any of them
    assert error(one) < error(whole)
    assert all(len(value) == most for value in first.values())

    new = one.log.counts["refused_splats"]
    one.state.take_over(part(full, 4, 6).state)  # as a map of a run that might have more
    assert one.add_keyframe(keyframe(7)) == 0
    assert 0 < one.log.counts["refused_splats"] - new <= SIZE[0] * SIZE[1], "no more than the keyframe's own"


def test_a_join_leaves_a_known_map_that_has_more_than_max_splats_as_large() -> None:
    """One that was made with a higher `max_splats`, and is gone on with."""
    free = replace(CONFIG, iterations=0)
    one = OnlineMapper(replace(free, density_control=DensityControlConfig(max_splats=40)))
    one.add_keyframe(keyframe(0))
    larger = mapped([1, 2], np.eye(4), 1.0, {}).state.tensors()
    one.state.become(larger)
    one.join(mapped([4], np.eye(4), 1.0, {}))
    assert len(one.state) == len(larger["means"]) > 40


def test_a_map_that_becomes_smaller_is_judged_by_a_bounded_number_of_images() -> None:
    mapper = mapped([0, 2], np.eye(4), 1.0, {})
    judged: list[int] = []

    def render(splats: Splats, view: TrainingView) -> Render:
        judged.append(view.index)
        return mapper.trainer._judged(mapper.median_depth)(splats, view)

    views = [replace(mapper.views[i % 2], index=i) for i in range(3 * JUDGES)]
    assert bound(mapper.state, views, render, len(mapper.state) - 1, torch.Generator()) == 1
    assert JUDGES / 2 <= len(judged) <= JUDGES
    assert max(judged) >= len(views) - 4, "spread over all"


def test_what_late_splats_brought_is_joined_too() -> None:
    one, other = OnlineMapper(CONFIG), mapped([1, 2], np.eye(4), 1.0, {})
    one.schedule.late, other.schedule.late = 2, 3
    one.join(other)
    assert one.schedule.late == 5


def test_a_part_without_a_keyframe_is_no_part_of_the_map() -> None:
    atlas = Atlas(OnlineMapper(CONFIG))
    for index in range(3):
        atlas.add(keyframe(index), 0)
    pose = np.full((4, 4), np.nan)
    assert atlas.add(replace(keyframe(3), world_from_cam=pose), 1) is None
    atlas.finish()
    assert atlas.current.log.values["segments_apart"] == 0
    assert not any("lost" in text for text in atlas.current.log.warnings)
    assert [known.index for known in atlas.current.views] == [0, 1, 2], "that of the keyframes is gone on with"


@pytest.mark.parametrize("spent", [None, 0, 1])
def test_a_join_leaves_the_keyframes_that_its_correction_moved_what_they_are_owed(spent: int | None) -> None:
    """spent: a part of which nothing that was owed is left, by its segment; the stream is in the later one."""
    atlas = Atlas(OnlineMapper(CONFIG))
    for index in (0, 1, 3, 4):
        atlas.add(keyframe(index), int(index > 2))
        while atlas.step():
            pass
    for part in atlas.parts.values():
        for view in part.views:
            view.loss_fast = 0.0  # to which it never comes back
    if spent is not None:
        atlas.parts[spent].schedule.beside = 0
    before, moved = sum(part.iterations for part in atlas.parts.values()), np.array([0, 1, 3, 4])
    poses = np.stack([AWAY @ pose_on_arc(k / 8) for k in moved])
    atlas.correct(moved, poses, np.ones(4), np.zeros(4, np.int32))
    assert len(atlas.parts) == 1
    while atlas.step():
        pass
    assert atlas.current.iterations - before == CONFIG.iterations
