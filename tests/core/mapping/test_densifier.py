"""What a keyframe's noise does to the number of its splats, and a map that is full."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import densifier
from mvsgs_core.mapping.densifier import noise_variance
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_maps import CONFIG
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


@pytest.mark.parametrize("sigma", [0.005, 0.03])
def test_noise_is_told_from_what_the_map_lacks(sigma: float) -> None:
    rng = np.random.default_rng(3)
    errors = sigma * rng.standard_normal((20_000, 3))
    assert noise_variance(np.mean(errors**2, axis=1)) == pytest.approx(sigma**2, rel=0.05)
    errors[10_000:] += rng.uniform(-0.3, 0.3, (10_000, 3))  # half of the view is not in the map yet
    assert noise_variance(np.mean(errors**2, axis=1)) < 2.0 * sigma**2


def test_a_noisy_keyframe_gets_fewer_splats_than_one_whose_noise_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def second(sigma: float) -> int:
        """Splats of the second keyframe."""
        mapper = OnlineMapper(CONFIG)
        mapper.add_keyframe(_noisy(0, 0.0, sigma))
        while mapper.step():
            pass
        return mapper.add_keyframe(_noisy(1, 1.0, sigma))

    with_noise = second(8.0)
    monkeypatch.setattr(densifier, "noise_variance", lambda squared: 0.0)
    assert 0 < with_noise < 0.95 * second(8.0)


def test_what_a_mask_covers_is_no_part_of_the_usual_error(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = OnlineMapper(CONFIG)
    keyframe = rgbd_keyframe(0, pose_on_arc(0.0))
    mapper.add_keyframe(keyframe)
    view = training_view(keyframe, keyframe.world_from_cam, None, torch.device("cpu"))
    image, valid = view.target.numpy(), np.ones(view.size, dtype=bool)
    noise = np.random.default_rng(0).normal(0.0, 0.01, image.shape)
    shown = (image + noise).astype(np.float32)
    shown[:8, -8:] += 0.2  # what the map has wrong
    solid = torch.ones(view.size)

    def residual(color: np.ndarray, valid: np.ndarray) -> np.ndarray:
        render = SimpleNamespace(color=torch.from_numpy(color), opacity=solid, depth=solid)
        monkeypatch.setattr(mapper.densifier, "render", lambda _: render)
        return mapper.densifier._residual(view, image, valid)[0][:8, -8:]

    columns = round(0.6 * view.size[1])
    covered = shown.copy()
    covered[:, :columns], valid[:, :columns] = 1.0 - image[:, :columns], False
    whole = residual(shown, np.ones_like(valid))
    assert whole.min() > 0.01
    np.testing.assert_allclose(residual(covered, valid), whole, rtol=0.05)


def test_a_full_map_says_so_in_one_sentence() -> None:
    mapper = OnlineMapper(replace(CONFIG, density_control=DensityControlConfig(max_splats=50)))
    for index in range(3):
        mapper.add_keyframe(rgbd_keyframe(index, pose_on_arc(index / 2)))
        mapper.state.keep(torch.arange(len(mapper.state)) > index)  # as density control does
    assert mapper.log.warnings == ["the map is full: max_splats=50; what is new is not mapped"]


def _noisy(index: int, t: float, sigma: float) -> RGBDKeyframe:
    """sigma: gray levels."""
    view = rgbd_keyframe(index, pose_on_arc(t))
    noise = sigma * np.random.default_rng(index).standard_normal(view.image.shape)
    return replace(view, image=np.clip(np.round(view.image + noise), 0, 255).astype(np.uint8))
