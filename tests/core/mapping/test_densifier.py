"""What a keyframe's noise does to the number of its splats, and a map that is full."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import densifier
from mvsgs_core.mapping.densifier import noise_variance
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
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
