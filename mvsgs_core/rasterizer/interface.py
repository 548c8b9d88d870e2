"""What the rasterizer and its back ends share: the settings of a render, the render that comes back, the constants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.rasterizer.splats import Splats

BLUR = 0.3  # px^2, low-pass on the diagonal of the image covariance
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
CLAMP_MARGIN = 0.3  # of tan(fov): how far beyond the image the Jacobian follows x/z and y/z
MIN_COMPENSATION = 0.005  # floor of the antialiased opacity factor
MAX_MOTION = 0.5  # of the image's width or height: how far a splat moves while the image is read, at most
MAX_VARIANCE = 1e16  # px^2
MAX_REACH = 1e12  # of m, where an exact kernel of a small exponent ends at the latest
MIN_QUATERNION = 1e-8


@dataclass(frozen=True)
class RenderSettings:
    """What the back ends get besides the splats: a checked camera and the switches. The C++ kernels read it by name."""

    pose: Tensor  # (4, 4) float64 world_from_cam, may carry a gradient
    intrinsics: tuple[float, ...]  # fx, fy, cx, cy, px at `size`
    size: tuple[int, int]  # height, width, px
    readout: tuple[float, ...]  # (6,) the camera's twist between first and last row, see `rasterize`; 0: no shutter
    exact: bool  # the generalized exponential of each splat's beta, else the Gaussian
    background: tuple[float, ...]  # red, green, blue
    near: float  # map units
    antialiased: bool
    degree: int  # of the spherical harmonics
    weights: bool  # whether to find the largest blending weight of every splat
    threads: int  # 0 = as many as OpenMP would take


@dataclass(frozen=True)
class Moved:
    """How a field of the splats is stepped: by Adam, at a rate that falls from `rate` to `final_rate`."""

    name: str
    first: Tensor  # moments, of the field's shape
    second: Tensor
    rate: float
    final_rate: float
    low: float  # values are kept inside
    high: float
    lead: int  # columns of the flattened field that take the full rate,
    tail: float  # the others this fraction of it


@dataclass
class SplatStep:
    """A step of Adam that the backward pass takes while it makes the gradients, which are then not kept.

    Only splats that the image shows are stepped, each by its own age; one with a gradient or a step that is not finite
    stays as it was.
    """

    moved: list[Moved]
    ages: Tensor  # (N,) int32 steps of each splat so far; counted on
    means2d_gradient: Tensor  # (N,) to which the length of `Render.means2d.grad` is added,
    means2d_views: Tensor  # (N,) and 1, of the splats that the image shows
    constants: tuple[float, float, float]  # beta 1, beta 2, epsilon
    decay_steps: int  # of a splat, until the rate is final
    refused: int = 0  # splats whose step was; the backward pass says it


@dataclass
class Backward:
    """What a backward pass refused; it fills this in when it runs."""

    refused: int | None = None  # splats whose gradients were not finite and are 0; None: not run, or not counted there


@dataclass
class Render:
    """A rendered view and what density control reads from it; H, W pixels, N splats."""

    color: Tensor  # (H, W, 3), nominally 0 to 1, not clamped
    depth: Tensor  # (H, W), expected z in map units, 0 where opacity is 0
    opacity: Tensor  # (H, W), 0 to 1
    visible: Tensor  # (N,) bool: in front, on the image, opacity at least 1/255
    radii: Tensor  # (N,), half of the longer side of the splat's box on the image, px; 0 if not visible
    # empty, or without gradient, where the splats are stepped, or nothing but opacities is trained
    means2d: Tensor  # (N, 2) zeros; after backward .grad is dL/d(mean on the image) in halves of the image, as in 3DGS
    weight_max: Tensor | None  # (N,), the largest blending weight at any pixel; None unless asked for
    refused: int  # splats left out because a parameter is not finite or degenerate
    backward: Backward  # what the backward pass reports, once it has run


def means2d_leaf(splats: Splats, settings: RenderSettings) -> Tensor:
    """Zeros (N, 2) for `Render.means2d`; they take a gradient where anything else does."""
    inputs = [*splats.tensors().values(), settings.pose]
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs)
    return splats.means.new_zeros(len(splats), 2).requires_grad_(wanted)


def as_bytes(color: Tensor) -> np.ndarray:
    """uint8 of values from 0 to 1; what is beyond is cut."""
    return np.asarray((color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy())
