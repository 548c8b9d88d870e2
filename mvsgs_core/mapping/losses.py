"""The training loss: a sum of weighted terms.

The photometric ones are those of GES (Hamdi et al. 2024): L1 + SSIM + an L1 inside a frequency-modulated, edge-aware
mask. The mask comes from a difference of Gaussians of the render, whose width moves with the training's progress
`frequency` in 0 to 100: in the first half the smooth regions are kept (the mask is inverted), in the second the edges.
An online run, whose length is not known ahead, gives each view its own progress until the stream ends.

One more term: its weight in `LossWeights`, its function in `TERMS`. Another loss altogether, in a file of one's own or
in a program: `training.loss_function`, a function of `LossInputs`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from mvsgs_core.named_modules import import_named
from mvsgs_core.rasterizer.interface import Render
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.rasterizer.ssim import image_loss
from mvsgs_core.setting_ranges import at_least

LOWERED = 0.2  # scale at which the mask is made
TINY = 1e-20


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; null: what the choice of `loss` has, see `LOSSES`; 0: the term is left out."""

    l1: float | None = None  # of the mean absolute error
    ssim: float | None = None  # of 1 - SSIM
    frequency: float | None = None  # of the L1 inside the frequency-modulated mask

    def __post_init__(self) -> None:
        at_least(self, l1=0, ssim=0, frequency=0)


Loss = Literal["ssim", "ges"]
LOSSES: dict[Loss, LossWeights] = {
    "ssim": LossWeights(l1=0.8, ssim=0.2),  # as 3DGS
    "ges": LossWeights(l1=0.3, ssim=0.2, frequency=0.5),  # as GES's released code
}


@dataclass(frozen=True)
class LossInputs:
    """What a term is computed from: one iteration's render, which carries gradients, and what it should show."""

    render: Render
    target: Tensor  # (H, W, 3); equal to the render where the keyframe's pixels are left out
    splats: Splats  # of the map, in its unit
    frequency: float  # the progress of the training, 0 to 100
    threads: int | None  # None: all


LossFunction = Callable[[LossInputs], Tensor]
_GIVEN: dict[str, LossFunction] = {}  # by a program, under the name that its configuration has


def name_of(function: LossFunction) -> str:
    """What `training.loss_function` is for a function of this program, be it in a notebook or within another one.

    Raises TypeError for what cannot be called.
    """
    if not callable(function):
        raise TypeError(f"a loss is a function of LossInputs, not {type(function).__name__}")
    plain = f"{function.__module__}.{getattr(function, '__qualname__', type(function).__qualname__)}"
    name, number = plain, 1
    while _GIVEN.setdefault(name, function) is not function:  # another one of that name, as a cell run twice makes
        number += 1
        name = f"{plain}#{number}"
    return name


def loss_function(name: str) -> LossFunction:
    """The function `module.function`: one of this program, or found as `import_named` does. Raises ValueError."""
    if name in _GIVEN:
        return _GIVEN[name]
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(import_named(module), attribute, None)
    except (ImportError, ValueError) as error:
        raise ValueError(f"training.loss_function={name}: must be module.function of LossInputs; {error}") from error
    if not callable(found):
        raise ValueError(f"training.loss_function={name}: there is no function {attribute!r} in {module}")
    given: LossFunction = found
    return given


def own_loss(function: LossFunction, inputs: LossInputs) -> Tensor:
    """What a user's loss makes of the inputs. Raises TypeError where that is nothing to be minimized."""
    loss = function(inputs)
    if not isinstance(loss, Tensor) or loss.ndim != 0 or not loss.requires_grad:
        what = f"a tensor of shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
        raise TypeError(
            f"the loss function must return a scalar tensor with a gradient to inputs.render or inputs.splats; it "
            f"returned {what}"
        )
    return loss


def weights_of(loss: Loss, chosen: LossWeights) -> dict[str, float]:
    """The weight of each term: the chosen ones, for others the loss's."""
    given = {name: value for name, value in vars(chosen).items() if value is not None}
    return {name: value or 0.0 for name, value in vars(replace(LOSSES[loss], **given)).items()}


def training_loss(inputs: LossInputs, weights: dict[str, float]) -> Tensor:
    """The sum of all terms, a scalar."""
    parts = [part for term in TERMS if (part := term(inputs, weights)) is not None]
    return sum(parts[1:], start=parts[0])


def frequency_of(iterations: int, horizon: int) -> float:
    """Progress 0 to 100 of a view that was trained on `iterations` times and counts as done after `horizon`."""
    return 100.0 * min(1.0, iterations / max(1, horizon))


def mask_sigma(frequency: float) -> float:
    """Standard deviation in lowered pixels of the narrower Gaussian."""
    return 0.1 + 0.1 * (frequency if frequency < 50.0 else 100.0 - frequency)


def lowered_gray(image: Tensor) -> Tensor:
    """(1, 1, h, w): the mean of the channels of (H, W, 3) at 0.2 of the size, at least a pixel."""
    gray = image.mean(dim=-1)[None, None]
    if min(gray.shape[2:]) * LOWERED >= 1.0:
        # coordinates by the factor, not by the ratio of the sizes, as in the released code
        return functional.interpolate(
            gray, scale_factor=LOWERED, mode="bilinear", align_corners=False, recompute_scale_factor=False
        )
    size = [max(1, int(side * LOWERED)) for side in gray.shape[2:]]
    return functional.interpolate(gray, size=size, mode="bilinear", align_corners=False)


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian of (1, 1, h, w), zeros beyond the border, window of 2 round(3 sigma) + 1 with weights that sum to 1."""
    radius = round(3.0 * sigma)
    offsets = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    window = torch.exp(-(offsets**2) / (2.0 * sigma * sigma))
    window = window / window.sum()
    rows = functional.conv2d(image, window.view(1, 1, -1, 1), padding=(radius, 0))
    return functional.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, radius))


def difference_of_gaussians(lowered: Tensor, frequency: float) -> Tensor:
    """Edges of (1, 1, h, w) at the width of a frequency; taken in float64, as at the ends they are of the size 1e-6."""
    sigma, exact = mask_sigma(frequency), lowered.double()
    return (_blur(exact, sigma) - _blur(exact, 2.0 * sigma)).to(lowered.dtype)


def edge_response(image: Tensor, frequency: float) -> Tensor:
    """(H, W) in 0 to 1: the difference of Gaussians of a render (H, W, 3), normalized, inverted below frequency 50.

    A uniform image has no edges: 0, or 1 where inverted. Raises ValueError for a frequency outside of 0 to 100.
    """
    if not 0.0 <= frequency <= 100.0:
        raise ValueError(f"frequency {frequency}: expected 0 to 100")
    with torch.no_grad():
        edges = difference_of_gaussians(lowered_gray(image), frequency)
        raised = functional.interpolate(edges, size=image.shape[:2], mode="bilinear", align_corners=False)[0, 0]
        low, high = raised.min(), raised.max()
        response = (raised - low) / (high - low).clamp(min=TINY)
        return 1.0 - response if frequency < 50.0 else response


def frequency_mask(image: Tensor, frequency: float) -> Tensor:
    """(H, W) bool of a render (H, W, 3), without gradient: where the third term looks."""
    return edge_response(image, frequency) >= 0.5


def photometric_loss(inputs: LossInputs, weights: dict[str, float]) -> Tensor:
    """L1, SSIM (1 - SSIM) and the masked L1, mean |m image - m target|, which one kernel computes together.

    Means are over all pixels, the masked one too. The gradient goes to the render's color, none through the mask m.
    """
    image, extra = inputs.render.color, None
    if weights["frequency"] > 0.0:
        extra = weights["frequency"] * frequency_mask(image.detach(), inputs.frequency).to(image.dtype)
    return image_loss(
        image, inputs.target, l1_weight=weights["l1"], ssim_weight=weights["ssim"], pixel_weight=extra,
        threads=inputs.threads,
    )  # fmt: skip


def only_photometric(weights: dict[str, float]) -> bool:
    """Whether the loss is L1 and SSIM alone, which `photograph_loss` makes of the photograph at once."""
    return TERMS[0] is photometric_loss and len(TERMS) == 1 and weights["frequency"] == 0.0


# Each gives its part of the sum, weighted: a scalar; None where its weight is 0. The first is never None.
Term = Callable[[LossInputs, dict[str, float]], Tensor | None]
TERMS: tuple[Term, ...] = (photometric_loss,)
