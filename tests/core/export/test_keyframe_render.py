"""A keyframe of a saved map: as its camera photographs it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvsgs_core.export.keyframe_render import rendered_keyframe
from mvsgs_core.photometry import vignetting_factor
from tests.support.tiny_map import INTRINSICS, SIZE, cameras_around, final_map


def test_the_vignetting_comes_after_the_exposure() -> None:
    final, cameras, vignetting = final_map(), cameras_around([0.0, 0.3]), np.array([-0.5, 0.1, 0.05])
    cameras.exposures[1] = [[0.5, 0, 0, 0.1], [0, 0.6, 0, 0.1], [0, 0, 0.7, 0.1]]
    exposed, plain = rendered_keyframe(final, cameras, 1)
    color, render = rendered_keyframe(final, replace(cameras, vignetting=vignetting), 1)
    factor = vignetting_factor(vignetting, INTRINSICS, SIZE)
    assert factor.min() < 0.7
    np.testing.assert_allclose(color.numpy(), exposed.numpy() * factor[..., None], atol=1e-6)
    torch.testing.assert_close(render.color, plain.color)  # the map's own colors
