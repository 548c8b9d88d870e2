"""Exposures that the tracker measured, in the map: its colors are the mean camera's, corrections move them along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.exposure import BRIGHTEST, ImageFormation, colors_of_map, recolored, relative_to_mean
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.photometry import IDENTITY, compose, inverse, vignetting_factor
from mvsgs_core.rasterizer.photograph_loss import unclipped
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats
from tests.support.rasterizer_scenes import POSE, intrinsics, random_splats
from tests.support.small_maps import FINE, mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (60, 80)
AFFINE = np.array([[1.3, 0, 0, -0.05], [0, 1.2, 0, 0.02], [0, 0, 0.8, 0.03]], np.float32)
DIM = np.array([[0.6, 0, 0, 0.01], [0, 0.55, 0, 0.0], [0, 0, 0.65, 0.02]], np.float32)
DARK = np.array([-0.4, 0.1, -0.2], np.float32)
CONFIG = MapperConfig(iterations=30, refinement=0, threads=1, insertion=FINE, device="cpu")


def photographed(
    view: RGBDKeyframe, exposure: np.ndarray | None, vignetting: np.ndarray | None = None, *, told: bool = True
) -> RGBDKeyframe:
    """The keyframe as a camera of that exposure and vignetting takes it; told: and says so."""
    affine, size = IDENTITY if exposure is None else exposure, (view.image.shape[0], view.image.shape[1])
    light = view.image / 255.0 @ affine[:, :3].T + affine[:, 3]
    if vignetting is not None:
        light = light * vignetting_factor(vignetting, view.intrinsics, size)[..., None]
    image = np.round(255.0 * light.clip(0.0, 1.0)).astype(np.uint8)
    return replace(view, image=image, **({"exposure": exposure, "vignetting": vignetting} if told else {}))


def arc(*times: float) -> list[RGBDKeyframe]:
    return [rgbd_keyframe(5 * k, pose_on_arc(t)) for k, t in enumerate(times)]


def error(mapper: OnlineMapper, k: int) -> float:
    """RMS of keyframe k's render to its image."""
    view = mapper.views[k]
    return float((mapper.render(view).color.clamp(0, 1) - view.target).square().mean().sqrt())


def test_the_mean_exposure_becomes_the_maps_and_renders_stay() -> None:
    mapper = OnlineMapper(MapperConfig(iterations=5, refinement=0, sh_degree=1, threads=1, device="cpu"))
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


def test_colors_of_the_map_undo_exposure_and_vignetting_and_enlarge_no_noise() -> None:
    rng = np.random.default_rng(0)
    color, factor = rng.uniform(0.2, 0.7, (*SIZE, 3)), vignetting_factor(DARK, np.array([60.0, 60, 39.5, 29.5]), SIZE)
    image = (color @ DIM[:, :3].T + DIM[:, 3]) * factor[..., None]
    np.testing.assert_allclose(colors_of_map(image, DIM, factor), color, atol=1e-6)
    white = colors_of_map(np.ones((1, 1, 3)), DIM)
    assert white.min() > 1.4  # what is white in a dark image is brighter than white
    nearly_black = np.full((1, 1), 1e-3)
    noise = np.full((1, 1, 3), 3.0 / 255.0)
    assert colors_of_map(noise, IDENTITY, nearly_black).max() < 4.1 * noise.max()
    assert colors_of_map(np.ones((1, 1, 3)), 0.07 * IDENTITY).max() == BRIGHTEST
    assert colors_of_map(np.zeros((1, 1, 3)), DIM).min() == 0.0


def test_a_keyframe_of_another_exposure_lays_no_second_skin_and_leaves_the_colors_as_they_are() -> None:
    first, second = arc(0.0, 0.1)
    steady = mapped([first, second], CONFIG)
    told, untold = (mapped([first, photographed(second, DIM, told=told)], CONFIG) for told in (True, False))
    assert told.log.counts["inserted"] < steady.log.counts["inserted"] + 0.02 * untold.log.counts["inserted"]
    assert untold.log.counts["inserted"] < 1.1 * steady.log.counts["inserted"]  # it is in the view's median error
    assert error(told, 0) < 1.15 * error(steady, 0)
    assert error(untold, 0) > 1.5 * error(told, 0)
    assert error(told, 1) < 1.15 * error(steady, 1)


def test_vignetting_is_in_the_renders_and_not_in_the_map() -> None:
    views = arc(0.0, 0.1, 0.2)
    steady = mapped(views, CONFIG).snapshot()
    told, untold = (mapped([photographed(v, None, DARK, told=told) for v in views], CONFIG) for told in (True, False))
    plain = steady.render(views[1].world_from_cam, views[1].intrinsics, (48, 64)).color
    for mapper, differs in ((told, False), (untold, True)):
        color = mapper.snapshot().render(views[1].world_from_cam, views[1].intrinsics, (48, 64)).color
        corner = (color - plain)[:6, :6].abs().mean()
        assert (corner > 0.1) == differs, float(corner)
    assert error(told, 1) < 0.03
    np.testing.assert_array_equal(told.snapshot().vignetting, DARK)
    assert untold.snapshot().vignetting is None
    half = told.render(told.views[1], (24, 32)).color
    whole = told.render(told.views[1]).color.reshape(24, 2, 32, 2, 3).mean(dim=(1, 3))
    assert float((half - whole).abs().mean()) < 0.02  # the factor is that of the size


def test_white_pulls_up_and_never_down() -> None:
    """Of a bright keyframe, cut off at white, and a dark one that shows it all, the map has the latter's colors."""
    first, second = arc(0.0, 0.05)
    bright = photographed(first, 2.5 * IDENTITY)
    dark = photographed(second, 0.5 * IDENTITY)
    assert (bright.image == 255).mean() > 0.3
    mapper = mapped([bright, dark, replace(bright, index=10)], replace(CONFIG, iterations=60))
    color = mapper.render(mapper.views[1]).color * 2.0
    off = np.abs(color.numpy() - second.image / 255.0)
    assert np.median(off) < 0.02
    assert off[second.image > 0.6 * 255].mean() < 0.05


def test_a_render_beyond_white_has_no_gradient_where_the_photograph_is_white_only() -> None:
    mapper = mapped([photographed(arc(0.0)[0], 2.5 * IDENTITY)], CONFIG)
    view = mapper.views[0]
    with torch.no_grad():
        mapper.state.splats.sh[:, 0] += 3.0  # all is far beyond white
    color = rasterize(
        mapper.state.detached(), view.refined_from_cam, view.intrinsics, view.size, exposure=view.exposure
    ).color
    target, white = unclipped(view.target, color), view.target == 1.0
    solid = (color > 1.0) & white
    assert bool(solid.any())
    assert torch.equal(target[solid], color[solid])
    assert torch.equal(target[~white], view.target[~white])


@pytest.mark.parametrize("at", ["dark", "white"])
def test_gradients_pass_exposure_vignetting_and_the_cut_in_float64(at: str) -> None:
    """Against finite differences, for the splats' colors, the pose and the exposure."""
    size = (5, 6)
    splats = random_splats(4, 4, seed=7, log_scale=0.3)
    fields = [value.double() for value in splats.tensors().values()]
    factor = torch.from_numpy(vignetting_factor(DARK, intrinsics(size), size)).double()[..., None]
    target = torch.full((*size, 3), 0.4 if at == "dark" else 1.0, dtype=torch.float64)
    target[0] = 0.0

    def loss(sh: torch.Tensor, twist: torch.Tensor, exposure: torch.Tensor) -> torch.Tensor:
        given = dict(zip(splats.tensors(), fields)) | {"sh": sh}
        render = rasterize(
            Splats(**given), POSE, intrinsics(size), size, backend="reference", exposure=exposure, pose_delta=twist
        )
        color = render.color * factor
        return (color - unclipped(target, color)).square().sum()

    sh = (3.0 * splats.sh).double().requires_grad_()
    twist = torch.full((6,), 0.02, dtype=torch.float64, requires_grad=True)
    exposure = torch.from_numpy(3.0 * AFFINE).double().requires_grad_()
    assert torch.autograd.gradcheck(loss, (sh, twist, exposure), eps=1e-6, atol=1e-6, rtol=1e-4)


def test_without_exposures_the_map_is_that_of_exposure_off_to_the_bit() -> None:
    views = arc(0.0, 0.2, 0.4)
    off = mapped(views, replace(CONFIG, training=TrainingConfig(exposure=False)))
    for given in (views, [replace(v, exposure=IDENTITY, vignetting=np.zeros(3, np.float32)) for v in views]):
        on = mapped(given, CONFIG)
        for name, value in off.state.tensors().items():
            assert torch.equal(on.state.tensors()[name], value), name
        np.testing.assert_array_equal(on.snapshot().exposures, np.stack([IDENTITY] * 3))
    refused = mapped([photographed(v, AFFINE, DARK) for v in views], off.config)
    assert all(view.measured is None for view in refused.views)
    assert refused.photometry.vignetting is None


def test_a_common_change_of_gauge_changes_no_render_and_a_late_exposure_is_as_one_known_at_once() -> None:
    first, second = arc(0.0, 0.3)
    exposed = [photographed(first, AFFINE), photographed(second, DIM)]
    mapper = mapped(exposed, CONFIG)
    with torch.no_grad():
        mapper.state.splats.sh.mul_(0.7)  # no color is at its limit, 0, which a gauge moves
    before = [mapper.render(view).color for view in mapper.views]
    gauge = np.array([[0.8, 0, 0, 0.01], [0, 0.9, 0, 0], [0, 0, 1.1, -0.02]])
    changed = np.stack([compose(e.exposure, inverse(gauge)) for e in exposed if e.exposure is not None])
    mapper.photometry.take([0, 5], changed.astype(np.float32), None, Stats())
    colors = mapper.state.splats.sh.detach().clone()
    assert mapper.expose() == len(mapper.state)
    torch.testing.assert_close(mapper.state.splats.sh.detach(), recolored(colors, gauge), atol=1e-5, rtol=0)
    for view, image in zip(mapper.views, before, strict=True):
        torch.testing.assert_close(mapper.render(view).color, image, atol=1e-5, rtol=0)
    assert mapper.expose() == 0

    late = mapped([replace(exposed[0], exposure=None)], CONFIG)
    late.photometry.take([0], AFFINE[None], None, Stats())
    late.expose()
    at_once = mapped([exposed[0]], CONFIG)
    colors = [m.snapshot().render(first.world_from_cam, first.intrinsics, (48, 64)).color for m in (late, at_once)]
    assert float((colors[0] - colors[1]).abs().mean()) < 0.02
    late.photometry.take([0], np.full((1, 3, 4), np.nan, np.float32), None, Stats())
    late.expose()
    assert late.views[0].measured is None
    np.testing.assert_array_equal(late.views[0].exposure.numpy(), IDENTITY)


@pytest.mark.parametrize("value", [np.inf, 1e9, 0.0, -np.inf])
def test_what_no_camera_has_is_refused_and_counted_and_the_map_stays_sound(value: float) -> None:
    wrong = IDENTITY.copy()
    wrong[1, 1] = value
    mapper = mapped(
        [replace(arc(0.0)[0], exposure=wrong, vignetting=np.array([value or -3.0, 0, 0], np.float32))], CONFIG
    )
    assert mapper.log.counts["refused_exposures"] == 2
    assert any("no camera has" in text for text in mapper.log.warnings)
    assert mapper.views[0].measured is None
    assert mapper.photometry.vignetting is None
    assert all(bool(torch.isfinite(value).all()) for value in mapper.state.tensors().values())


def test_none_is_as_it_was_and_an_identity_is_none_any_more() -> None:
    known, log = ImageFormation(), Stats()
    known.take([1, 2], np.stack([AFFINE, DIM]), DARK, log)
    kept = known.copy()
    known.take([1, 2], None, None, log)
    np.testing.assert_array_equal(known.exposures[2], DIM)
    assert known.vignetting is not None
    known.take([1], IDENTITY[None], np.zeros(3, np.float32), log)
    assert list(known.exposures) == [2]
    assert known.vignetting is None
    assert list(kept.exposures) == [1, 2]
    np.testing.assert_array_equal(kept.vignetting, DARK)
    assert not log.counts
