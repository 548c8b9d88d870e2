"""Exposures in the map: its colors are those of the mean camera, each keyframe has its own affine of them.

The tracker says the exposures (`ImageFormation`), and corrects them as it does poses; splats' colors then go with their
anchor keyframe as positions do. No color is ever fitted to a render. See `mvsgs_core.photometry` for the model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.photometry import IDENTITY, compose, inverse, is_exposure, is_vignetting, vignetting_factor
from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats

MIN_FACTOR = 0.25  # of vignetting that a color is divided by: below, the pixel's noise is what would be enlarged
BRIGHTEST = 4.0  # of the map's colors from an image: a dark keyframe's bright pixel is brighter than white
NO_EXPOSURE = "an exposure or a vignetting that no camera has was refused"


@dataclass
class ImageFormation:
    """How photographs come from the map's colors, as the tracker said last; mappers of one stream share it."""

    exposures: dict[int, np.ndarray] = field(default_factory=dict)  # (3, 4) float32 by keyframe; missing: the identity
    vignetting: np.ndarray | None = None  # (3,) float64 of the sensor; None: none

    def take(
        self, index: Iterable[int], exposures: np.ndarray | None, vignetting: np.ndarray | None, log: Stats
    ) -> None:
        """Exposures (K, 3, 4) of these keyframes, NaN: none, and the vignetting (3,); None: as they were.

        What no camera has is refused and counted: the identity.
        """
        for key, affine in zip(index, () if exposures is None else exposures):
            known = not np.isnan(affine).any() and not np.array_equal(affine, IDENTITY)
            if known and not is_exposure(affine):
                log.refuse("exposures", 1, NO_EXPOSURE)
                known = False
            if known:
                self.exposures[key] = affine.astype(np.float32)
            else:
                self.exposures.pop(key, None)
        if vignetting is not None:
            if not is_vignetting(vignetting):
                log.refuse("exposures", 1, NO_EXPOSURE)
            else:
                self.vignetting = vignetting.astype(np.float64) if vignetting.any() else None

    def colors_of_map(self, colors: np.ndarray, view: TrainingView) -> np.ndarray:
        """Colors (h, w, 3) of a keyframe's image, at any size, as the map has them."""
        if view.measured is None and self.vignetting is None:
            return colors
        size = (colors.shape[0], colors.shape[1])
        factor = None
        if self.vignetting is not None:
            factor = vignetting_factor(self.vignetting, view.intrinsics_at(size), size)
        return colors_of_map(colors, view.exposure.cpu().numpy(), factor)

    def copy(self) -> ImageFormation:
        """One that later changes do not reach; the arrays never change."""
        return replace(self, exposures=dict(self.exposures))


def colors_of_map(colors: np.ndarray, exposure: np.ndarray, factor: np.ndarray | None = None) -> np.ndarray:
    """Colors (h, w, 3) of an image as the map has them; factor: (h, w) of vignetting.

    Not cut off at 1: white in a dark image is brighter than that. Of a pixel that is saturated it is the least that the
    color can be; the training takes it from there.
    """
    flat = colors if factor is None else colors / np.maximum(factor, MIN_FACTOR)[..., None]
    back = inverse(exposure)
    return np.clip(flat @ back[:, :3].T + back[:, 3], 0.0, BRIGHTEST)


@torch.no_grad()
def recolor_with_anchors(state: MapState, changes: dict[int, np.ndarray]) -> int:
    """Takes the colors of all splats whose anchor is a key through an affine (3, 4); returns their number.

    The moments follow as in `deformation`: a gradient by the inverse's transpose.
    """
    if not changes or len(state) == 0:
        return 0
    splats, count = state.detached(), 0
    for key, affine in changes.items():
        chosen = torch.nonzero(state.anchors == key)[:, 0]
        splats.sh[chosen] = recolored(splats.sh[chosen], affine)
        back = torch.as_tensor(inverse(affine)[:, :3], device=state.device)
        for moment, matrix in ((state.first["sh"], back), (state.second["sh"], back.square())):
            moment[chosen] = (moment[chosen].to(torch.float64) @ matrix).to(torch.float32)
        count += len(chosen)
    return count


def recolored(sh: Tensor, affine: np.ndarray) -> Tensor:
    """Harmonics (N, B, 3) whose colors went through an affine (3, 4)."""
    given = torch.as_tensor(affine, dtype=torch.float64, device=sh.device)
    matrix, offset = given[:, :3], given[:, 3]
    changed = sh.to(torch.float64) @ matrix.T
    changed[:, 0] += (offset + matrix.sum(dim=1) * 0.5 - 0.5) / C0
    return changed.to(torch.float32)


def relative_to_mean(splats: Splats, exposures: np.ndarray) -> tuple[Tensor, np.ndarray]:
    """Harmonics (N, B, 3) in the colors of the mean of `exposures` (K, 3, 4), and those relative to it, mean identity.

    Both together render the same images as before.
    """
    mean = exposures.astype(np.float64).mean(axis=0)
    return recolored(splats.sh, mean), compose(exposures, inverse(mean)).astype(np.float32)
