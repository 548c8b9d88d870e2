"""A keyframe's exposure: fitted to the map, and the map's colors at the mean of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.exposure import IDENTITY, KEPT, colors_of_map, fitted_exposure, relative_to_mean
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.rasterizer.rasterize import rasterize
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (60, 80)
AFFINE = np.array([[1.3, 0, 0, -0.05], [0, 1.2, 0, 0.02], [0, 0, 0.8, 0.03]], np.float32)


def test_gain_and_offset_are_found_though_a_quarter_of_the_image_is_something_else() -> None:
    rng = np.random.default_rng(0)
    render = rng.uniform(0.1, 0.6, (*SIZE, 3))
    image = render @ AFFINE[:, :3].T + AFFINE[:, 3] + rng.normal(0, 0.01, (*SIZE, 3))
    image[:15] = rng.uniform(0.1, 0.9, (15, SIZE[1], 3))
    found = fitted_exposure(render, np.ones(SIZE), image)
    assert found is not None
    fitted = IDENTITY + (found - IDENTITY) / KEPT
    np.testing.assert_allclose(fitted, AFFINE, atol=0.03)
    np.testing.assert_allclose(colors_of_map(image[20:], fitted), render[20:], atol=0.1)


def test_a_map_that_shows_too_little_and_a_flat_image_say_nothing_wild() -> None:
    render = np.full((*SIZE, 3), 0.4)
    assert fitted_exposure(render, np.zeros(SIZE), render) is None
    assert fitted_exposure(render, np.ones(SIZE), np.ones_like(render)) is None  # all saturated
    found = fitted_exposure(render, np.ones(SIZE), render + 0.1)
    assert found is not None
    np.testing.assert_allclose(found[:, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found[:, 3], KEPT * 0.1, atol=1e-6)
    render[5, 5] = np.nan
    assert np.isfinite(fitted_exposure(render, np.ones(SIZE), render)).all()


def test_the_mean_exposure_becomes_the_maps_and_renders_stay() -> None:
    mapper = OnlineMapper(MapperConfig(iterations=5, refinement=0, sh_degree=1, threads=1))
    view = rgbd_keyframe(0, pose_on_arc(0.0))
    mapper.add_keyframe(view)
    splats = mapper.snapshot().splats
    splats.sh = 0.3 * splats.sh  # no color at its limits, 0 and 1
    splats.opacity_logits, splats.log_scales = splats.opacity_logits + 4.0, splats.log_scales + 0.7
    exposures = np.stack([AFFINE, 1.1 * IDENTITY, IDENTITY])
    sh, relative = relative_to_mean(splats, exposures)
    np.testing.assert_allclose(relative.mean(axis=0), IDENTITY, atol=1e-6)
    for before, after in zip(exposures, relative, strict=True):
        one, other = (
            rasterize(s, view.world_from_cam, view.intrinsics, SIZE, exposure=torch.from_numpy(e))
            for s, e in ((splats, before), (replace(splats, sh=sh), after))
        )
        solid = one.opacity > 0.99  # behind a part-transparent map there is black, which has no exposure
        assert solid.any()
        assert (one.color - other.color)[solid].abs().max() < 5e-3


def test_a_keyframe_of_another_exposure_starts_with_it_and_lays_no_second_skin() -> None:
    counts = {}
    for exposure in (False, True):
        mapper = OnlineMapper(
            MapperConfig(iterations=40, refinement=0, threads=1, training=TrainingConfig(exposure=exposure))
        )
        mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.0)))
        second = rgbd_keyframe(5, pose_on_arc(0.1))
        bright = np.clip(np.round(0.7 * second.image), 0, 255).astype(np.uint8)
        counts[exposure] = mapper.add_keyframe(replace(second, image=bright))
        if exposure:
            gains = mapper.views[1].exposure.detach().numpy()[:, :3].diagonal()
            np.testing.assert_allclose(gains, 0.7, atol=0.12)
    assert counts[True] < 0.5 * counts[False]


def test_a_camera_of_constant_exposure_hardly_drifts() -> None:
    """What is new comes from the last guess and makes the next one: their errors must not add up."""
    rng = np.random.default_rng(1)
    mapper = OnlineMapper(MapperConfig(iterations=10, refinement=0, threads=1, training=TrainingConfig(exposure=True)))
    for k, time in enumerate(np.linspace(0.0, 1.0, 12)):
        view = rgbd_keyframe(k, pose_on_arc(float(time)))
        noisy = np.clip(view.image + rng.normal(0.0, 8.0, view.image.shape), 0, 255).astype(np.uint8)
        mapper.add_keyframe(replace(view, image=noisy))
    gains = np.array([v.exposure.detach().numpy()[:, :3].diagonal() for v in mapper.views])
    assert np.abs(gains - 1.0).max() < 0.15
