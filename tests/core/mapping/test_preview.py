"""A preview of fewer splats than the map has."""

from __future__ import annotations

import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.preview import thinned
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
