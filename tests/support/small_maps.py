"""A map of the tiny scene, and how well it explains it."""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core.image_metrics import psnr
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.rasterizer.splats import Splats

FINE = InsertionConfig(price=0.02)  # of images so small that a rectangle of 8 pixels is a tenth of them
RARE = DensityControlConfig(every=100)  # maps of some 60 iterations have no round: it would leave them unsettled
CONFIG = MapperConfig(iterations=16, refinement=20, threads=1, insertion=FINE, density_control=RARE, device="cpu")


def empty_map() -> Splats:
    """A map of nothing."""
    none = torch.zeros(0)
    return Splats(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4), none, torch.zeros(0, 1, 3), none)


def mapped(views: list[RGBDKeyframe], config: MapperConfig = CONFIG) -> OnlineMapper:
    mapper = OnlineMapper(config)
    for view in views:
        mapper.add_keyframe(view)
    while mapper.step():
        pass
    for done in range(config.refinement):
        mapper.refine(done, config.refinement)
    return mapper


def score(mapper: OnlineMapper, view: RGBDKeyframe) -> float:
    near = 1e-3 * mapper.frame.length
    render = mapper.snapshot().render(view.world_from_cam, view.intrinsics, view.image.shape[:2], near=near)
    return psnr(render.color.clamp(0, 1).numpy(), view.image.astype(np.float32) / 255.0)
