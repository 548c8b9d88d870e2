"""The online mapper on a few tiny views of a colored box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core import geometry
from mvsgs_core.mapping import keyframe_store, losses, resting_images
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import ConvergenceConfig, RGBDKeyframe
from mvsgs_core.mapping.map_state import PARAMETERS
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.optimizer import OptimizerConfig
from tests.support.small_maps import CONFIG, mapped, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

TIMES = (0.0, 0.33, 0.66, 1.0)


def tiny_views(origin: float = 0.0, unit: float = 1.0) -> list[RGBDKeyframe]:
    return [rgbd_keyframe(5 * k, pose_on_arc(t), origin=origin, unit=unit) for k, t in enumerate(TIMES)]


def test_a_view_between_the_keyframes_is_rendered_well() -> None:
    mapper = mapped(tiny_views())
    assert score(mapper, rgbd_keyframe(99, pose_on_arc(0.5))) > 30.0
    assert mapper.iterations <= 4 * 16 + 20
    assert mapper.log.skipped["pixels_explored"] > 2000
    assert mapper.log.seconds["refinement"] > 0
    assert not mapper.log.warnings


@pytest.mark.slow
@pytest.mark.parametrize(("origin", "unit"), [(1e6, 1.0), (-1e5, 1e-3), (0.0, 1e4)])
def test_the_worlds_origin_and_unit_do_not_matter(origin: float, unit: float) -> None:
    here = score(mapped(tiny_views()), rgbd_keyframe(99, pose_on_arc(0.5)))
    there = score(mapped(tiny_views(origin, unit)), rgbd_keyframe(99, pose_on_arc(0.5), origin=origin, unit=unit))
    assert there > here - 1.0


def test_the_same_seed_gives_the_same_map() -> None:
    one, two = mapped(tiny_views()), mapped(tiny_views())
    for name in PARAMETERS:
        assert torch.equal(getattr(one.state.splats, name), getattr(two.state.splats, name))


def test_it_does_not_matter_when_the_owed_iterations_are_done() -> None:
    early, late = OnlineMapper(CONFIG), OnlineMapper(CONFIG)
    for view in tiny_views():
        early.add_keyframe(view)
        while early.step():
            pass
        late.add_keyframe(view)
    while late.step():
        pass
    assert torch.equal(early.state.splats.means, late.state.splats.means)


def test_realtime_drops_what_older_keyframes_are_owed() -> None:
    mapper = OnlineMapper(replace(CONFIG, realtime=True))
    for view in tiny_views():
        mapper.add_keyframe(view)
        mapper.step()
    assert mapper.iterations == 4
    assert mapper.log.skipped["iterations_realtime"] == 3 * 15
    assert mapper.schedule.pending == 15


def test_corrections_move_the_map_rigidly_with_scale() -> None:
    views = tiny_views()
    mapper = mapped(views)
    expected = score(mapper, views[1])
    shift = geometry.se3_exp(np.array([0.4, -0.2, 0.7, 0.3, -0.5, 0.2]))
    poses = []
    for view in views:
        pose = view.world_from_cam.copy()
        pose[:3, 3] *= 2.0
        poses.append(shift @ pose)
    moved = mapper.correct(np.array([v.index for v in views]), np.stack(poses), np.full(4, 2.0))
    assert moved == len(mapper.state)
    assert score(mapper, replace(views[1], world_from_cam=poses[1])) == pytest.approx(expected, abs=0.1)
    assert mapper.snapshot().scale.tolist() == [2.0] * 4


def test_a_late_view_of_an_older_scale_is_converted() -> None:
    views = tiny_views()
    doubled = [replace(v, world_from_cam=_stretched(v.world_from_cam, 2.0)) for v in views]
    plain, corrected = OnlineMapper(CONFIG), OnlineMapper(CONFIG)
    for mapper in (plain, corrected):
        mapper.add_keyframe(views[0])
    index = np.array([v.index for v in views])
    corrected.correct(index, np.stack([v.world_from_cam for v in doubled]), np.full(4, 2.0))
    for view in views[1:]:
        plain.add_keyframe(view)
        corrected.add_keyframe(view)  # still of scale 1
    here = score(plain, views[2])
    there = score(corrected, doubled[2])
    assert there == pytest.approx(here, abs=1.0)
    depths = corrected.snapshot().splats.means.norm(dim=1).median() / plain.snapshot().splats.means.norm(dim=1).median()
    assert float(depths) == pytest.approx(2.0, abs=0.1)


def _stretched(pose: np.ndarray, factor: float) -> np.ndarray:
    result = pose.copy()
    result[:3, 3] *= factor
    return result


def test_bad_input_is_refused_counted_and_never_reaches_the_map() -> None:
    views = tiny_views()
    depth = views[0].depth.copy()
    depth[:10] = np.nan
    depth[10, :7] = -1.0
    image = views[1].image.astype(np.float32) / 255.0
    image[5:9, 3:8] = np.nan
    pose = views[2].world_from_cam.copy()
    pose[0, 3] = np.inf
    mapper = mapped(
        [
            replace(views[0], depth=depth),
            replace(views[1], image=image),
            replace(views[2], world_from_cam=pose),
            views[3],
        ],
    )
    mapper.correct(np.array([0, 5]), np.full((2, 4, 4), np.nan), np.ones(2))
    counts = mapper.log.counts
    assert counts["refused_depths"] == 10 * 64 + 7
    assert counts["refused_pixels"] == 20
    assert counts["refused_views"] == 1
    assert counts["refused_poses"] == 2
    assert len(mapper.log.warnings) == 4
    assert len(mapper.views) == 3
    for name in PARAMETERS:
        assert torch.isfinite(getattr(mapper.state.splats, name)).all()
    assert score(mapper, views[3]) > 28.0


def test_a_view_without_depth_adds_nothing_but_is_trained_on() -> None:
    views = tiny_views()
    mapper = OnlineMapper(CONFIG)
    empty = replace(views[0], depth=np.zeros((24, 32), np.float32), normals=None)
    assert mapper.add_keyframe(empty) == 0
    assert not mapper.step()
    assert mapper.add_keyframe(views[1]) > 0
    while mapper.step():
        pass
    assert mapper.views[0].visits > 0


def test_depth_smaller_than_the_image_is_used_at_its_own_size() -> None:
    view = tiny_views()[0]
    small = replace(view, depth=view.depth[::2, ::2].copy(), normals=view.normals[::2, ::2].copy())
    mapper = OnlineMapper(replace(CONFIG, insertion=InsertionConfig(price=0.0)))
    assert mapper.add_keyframe(small) == 48 * 64
    shown = mapper.render(mapper.views[0])
    assert (shown.opacity.numpy() > 0.5).all()


def test_the_map_never_grows_beyond_its_limit_and_says_so() -> None:
    config = replace(CONFIG, density_control=DensityControlConfig(max_splats=1000, every=10))
    mapper = mapped(tiny_views(), config)
    assert len(mapper.state) <= 1000
    assert any("max_splats" in text for text in mapper.log.warnings)


def test_every_skip_can_be_switched_off() -> None:
    config = replace(
        CONFIG,
        convergence=ConvergenceConfig(skip=False),
        training=TrainingConfig(selective=False),
        insertion=InsertionConfig(unexplored=False),
    )
    mapper = mapped(tiny_views(), config)
    assert mapper.iterations == 4 * 16 + 20
    assert not any(mapper.log.skipped.values())


def test_converged_keyframes_are_passed_over() -> None:
    convergence = ConvergenceConfig(visits=2, improvement=1.0, keep=0.0)
    mapper = mapped(tiny_views(), replace(CONFIG, convergence=convergence, refinement=0))
    assert mapper.log.skipped["iterations_converged"] + mapper.iterations == 4 * 16
    assert mapper.iterations <= 4 * 6


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["gaussian", "exact", "ges_scale"])
def test_every_kernel_trains_with_harmonics_and_exposure(kernel: str) -> None:
    training = TrainingConfig(kernel=kernel, betas=True)
    exposures = (0.95 + 0.05 * np.arange(9)[:, None, None]) * np.eye(3, 4)
    exposed = [replace(v, exposure=e.astype(np.float32)) for v, e in zip(tiny_views(), exposures)]
    mapper = mapped(exposed, replace(CONFIG, iterations=6, sh_degree=1, training=training))
    assert score(mapper, tiny_views()[1]) > 25.0
    betas = mapper.state.splats.betas.detach()
    assert bool((betas != betas[0]).any()) == (kernel != "gaussian")
    assert mapper.snapshot().splats.sh.shape[1] == 4
    assert not np.allclose(mapper.snapshot().exposures, np.eye(3, 4))


def test_wild_learning_rates_leave_the_map_finite() -> None:
    rates = OptimizerConfig()
    parts = ("means_final", "decay_steps", "max_scale_in_stream")
    wild = replace(rates, **{k: 100 * v for k, v in vars(rates).items() if k not in parts})
    mapper = mapped(tiny_views(), replace(CONFIG, optimizer=wild, iterations=30))
    for name in PARAMETERS:
        assert torch.isfinite(getattr(mapper.state.splats, name)).all()
    assert torch.isfinite(mapper.render(mapper.views[0]).color).all()


def test_images_are_kept_for_a_bounded_number_of_keyframes_spread_over_the_run() -> None:
    views = [rgbd_keyframe(k, pose_on_arc(k / 9)) for k in range(10)]
    mapper = mapped(views, replace(CONFIG, iterations=4, window=2, max_keyframes=5))
    kept = [view.index for view in mapper.views if view.has_image]
    assert len(kept) == 5
    assert kept[0] == 0
    assert kept[-2:] == [8, 9]
    assert max(np.diff(kept)) <= 4
    assert mapper.keyframes.image_bytes == 5 * 48 * 64 * 3
    assert len(mapper.snapshot().keyframes) == 10
    assert any("max_keyframes" in text for text in mapper.log.warnings)
    shift = np.stack([view.world_from_cam for view in views])
    shift[:, 0, 3] += 1.0
    assert mapper.correct(np.arange(10), shift, np.ones(10)) == len(mapper.state)


def test_images_on_disk_give_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [rgbd_keyframe(k, pose_on_arc(k / 9)) for k in range(10)]
    config = replace(CONFIG, iterations=4, window=2, refinement=4)
    memory, disk = (mapped(views, replace(config, images_in_memory=n)) for n in (1000, 3))
    assert [view.index for view in disk.views if not view.image_on_disk] == [7, 8, 9]
    assert disk.keyframes.image_bytes == 3 * 48 * 64 * 3
    assert all(torch.equal(a.image, b.image) for a, b in zip(memory.views, disk.views))
    for name in PARAMETERS:
        assert torch.equal(getattr(memory.state.splats, name), getattr(disk.state.splats, name))

    monkeypatch.setattr(keyframe_store, "room_of", lambda device: 2.5 * 48 * 64 * 3)
    narrow = mapped(views, config)  # as on a GPU whose memory ends there
    assert [view.index for view in narrow.views if not view.image_on_disk] == [8, 9]
    monkeypatch.undo()

    def full(image: torch.Tensor) -> torch.Tensor:
        raise OSError("no space left on device")

    monkeypatch.setattr(resting_images, "on_disk", full)
    stays = mapped(views, replace(config, images_in_memory=3))
    assert stays.keyframes.image_bytes == 10 * 48 * 64 * 3
    assert any("no space left" in text for text in stays.log.warnings)


def test_masks_rest_on_disk_with_their_images() -> None:
    mask = np.ones((48, 64), dtype=bool)
    mask[:10] = False
    views = [replace(rgbd_keyframe(k, pose_on_arc(k / 9)), mask=mask) for k in range(10)]
    config = replace(CONFIG, iterations=4, window=2, refinement=4)
    memory, disk = (mapped(views, replace(config, images_in_memory=n)) for n in (1000, 3))
    assert disk.keyframes.image_bytes == 3 * 48 * 64 * 4
    assert all(torch.equal(a.valid, b.valid) for a, b in zip(memory.views, disk.views))
    for name in PARAMETERS:
        assert torch.equal(getattr(memory.state.splats, name), getattr(disk.state.splats, name))


def test_gradients_that_are_not_finite_are_counted_and_the_map_stays_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    def with_one_bad_pixel(inputs: losses.LossInputs, weights: dict[str, float]) -> torch.Tensor:
        color = inputs.render.color
        pixel = color[24, 32, 0]
        return color.mean() + (pixel - pixel.detach()).abs().sqrt()  # 0, with a derivative of NaN

    monkeypatch.setattr(losses, "TERMS", (with_one_bad_pixel,))
    mapper = mapped(tiny_views()[:2], replace(CONFIG, iterations=4, refinement=0))
    assert mapper.log.counts["refused_gradients"] > 0
    assert any("gradients" in text for text in mapper.log.warnings)
    for name in PARAMETERS:
        assert torch.isfinite(getattr(mapper.state.splats, name)).all()


def test_the_refinement_is_as_long_as_the_map_is_large() -> None:
    assert MapperConfig().budget == 15
    assert [MapperConfig().refinement_of(count) for count in (0, 16, 17, 5000)] == [400, 400, 425, 125_000]
    assert MapperConfig(iterations=300).refinement_of(20) == 10_000
    assert MapperConfig(refinement=7).refinement_of(5000) == 7
    live = MapperConfig(realtime=True)
    assert live.budget == 30  # nothing waits for them
    assert [live.refinement_of(count) for count in (0, 30, 5000)] == [400, 750, 1000]  # for which somebody waits
    assert [live.refinement_of(20, images) for images in (20, 83, 84, 160, 500)] == [500, 500, 504, 960, 1000]
    assert MapperConfig().refinement_of(20, 500) == 500
    assert MapperConfig(realtime=True, iterations=7).budget == 7
    assert MapperConfig(realtime=True, refinement=3000).refinement_of(5000) == 3000


def test_in_real_time_frames_between_few_keyframes_make_the_refinement_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = OnlineMapper(replace(CONFIG, realtime=True, refinement=None))
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.5)))
    assert mapper.refinement == mapper.config.refinement_of(1)
    monkeypatch.setattr(type(mapper.keyframes), "trained", property(lambda self: [None] * 100))
    assert mapper.refinement == mapper.config.refinement_of(1, 100) == 600


def test_the_atlas_refines_for_as_long_as_its_map_asks_for() -> None:
    atlas = Atlas(OnlineMapper(replace(CONFIG, iterations=3, refinement=None)))
    atlas.add(rgbd_keyframe(0, pose_on_arc(0.5)), 0)
    while atlas.step():
        pass
    before = atlas.current.iterations
    while atlas.refine():
        pass
    assert atlas.current.iterations == before + 5 * 16
