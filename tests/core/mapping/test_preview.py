"""A preview of fewer splats than the map has."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import preview_arrays, thinned
from mvsgs_core.rasterizer.kernels import gaussian_std_ratio
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe


def test_a_third_of_the_splats_shows_the_map_without_holes() -> None:
    view = rgbd_keyframe(0, pose_on_arc(0.0))
    mapper = OnlineMapper(MapperConfig(threads=1, device="cpu"))
    mapper.add_keyframe(view)
    whole = mapper.state.detached()
    count = len(whole)
    assert thinned(whole, count) is whole
    fewer = thinned(whole, count // 3)
    assert len(fewer) <= count // 3
    assert len(thinned(whole, 0)) == 1

    def render(splats: Splats) -> torch.Tensor:
        size = view.image.shape[0], view.image.shape[1]
        return rasterize(splats, mapper.frame.local(view.world_from_cam), view.intrinsics, size).color

    stride = -(-count // (count // 3))
    holed = Splats(**{name: value[::stride] for name, value in whole.tensors().items()})
    error, holes = ((render(splats) - render(whole)).square().mean() for splats in (fewer, holed))
    assert error < 0.5 * holes


def test_shapes_of_splats_become_scales() -> None:
    """What shows a preview knows only Gaussians."""
    mapper = OnlineMapper(MapperConfig(threads=1, device="cpu", training=TrainingConfig(kernel="exact", betas=True)))
    mapper.add_keyframe(rgbd_keyframe(0, pose_on_arc(0.0)))
    plain = preview_arrays(mapper, len(mapper.state))["covariances"]
    mapper.state.splats.betas.data.fill_(4.0)
    ratio = float(gaussian_std_ratio(torch.tensor([4.0])))
    assert abs(ratio - 1.0) > 0.2
    shaped = preview_arrays(mapper, len(mapper.state))["covariances"]
    np.testing.assert_allclose(shaped, ratio**2 * plain, rtol=1e-4)
    assert shaped.shape == plain.shape == (len(mapper.state), 3, 3)
