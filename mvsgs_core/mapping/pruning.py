"""Splats that a map does without: those that none of its images would miss are taken out, all at once.

A pixel's color C is linear in each splat's opacity o: without the splat, all others as they are, it is C - o dC/do.
What its removal costs is that change, squared and summed over the pixels of an image: the saliency of Optimal Brain
Damage (LeCun, Denker, Solla 1990), here exact. A sum of squares is the mean square of the sum with random signs
(Hutchinson 1990), so that one backward pass with a random sign at each pixel estimates the cost of all splats.

A splat that other splats hide, or that few images see, costs little there and may be all that another view has to show:
the cost is the mean over the images that see it, and a hidden one stays. Of the others the cheapest go, as many as
would together add no more than a fraction to the error that the images have anyway.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.rasterizer.interface import Render
from mvsgs_core.rasterizer.splats import Splats

JUDGES = 64  # images of which a map that is to become smaller is judged by at most, as the stream goes on meanwhile
PASSES = 12  # backward passes in all, at least: each image has one, of a few images each has more, with other signs
OPAQUE = 0.98  # an opacity above is taken as this: near the rasterizer's greatest alpha no color depends on it
HIDDEN = 0.3  # light that reaches the camera past what is before a splat, where most does: with less, it is hidden


def prune(
    state: MapState, views: Iterable[TrainingView], render: Callable[[Splats, TrainingView], Render], fraction: float,
    generator: torch.Generator,
) -> int:  # fmt: skip
    """Removes the splats that would add least to the squared error of the views' images; returns their number.

    render: splats as a view photographs them, with gradients and weights; fraction: of the squared error that the
    images have, which those removed may add. A splat whose anchor is not among the views stays.
    """
    given = list(views)
    if not len(state) or not given or not fraction > 0:
        return 0
    cost, error = removal_cost(state, given, render, generator)
    known = torch.isin(state.anchors, torch.tensor([view.index for view in given], device=state.device))
    cost = torch.where(known, cost, math.inf)
    order = torch.argsort(cost, stable=True)
    return _remove(state, order[torch.cumsum(cost[order], 0) <= fraction * error])


def bound(
    state: MapState, views: list[TrainingView], render: Callable[[Splats, TrainingView], Render], count: int,
    generator: torch.Generator,
) -> int:  # fmt: skip
    """Removes all but `count` splats, those first that would add least to the squared error of the images of some of
    the views, spread over all, those last that none of them says anything of; returns their number. render: as in
    `prune`."""
    beyond = len(state) - count
    if beyond <= 0:
        return 0
    judges = views[:: -(-len(views) // JUDGES)]
    cost, _ = removal_cost(state, judges, render, generator)
    return _remove(state, torch.argsort(cost, stable=True)[:beyond])


def _remove(state: MapState, splats: Tensor) -> int:
    keep = torch.ones(len(state), dtype=torch.bool, device=state.device)
    keep[splats] = False
    state.keep(keep)
    return len(splats)


def removal_cost(
    state: MapState, views: list[TrainingView], render: Callable[[Splats, TrainingView], Render],
    generator: torch.Generator,
) -> tuple[Tensor, float]:  # fmt: skip
    """(N,) float64 squared error, summed over pixels and colors, that the views' images would gain without each splat,
    if they all saw it as those do that see it; infinite where it is hidden from all. And the error that they have. Of
    pixels that are left out of the training neither counts."""
    splats, error = state.detached(), 0.0
    total = torch.zeros(len(state), dtype=torch.float64, device=state.device)
    seen, weight = torch.zeros_like(state.means2d_views), torch.zeros_like(state.means2d_views)
    logits = splats.opacity_logits.clamp(max=math.log(OPAQUE / (1.0 - OPAQUE)))
    opacity = torch.sigmoid(logits)
    probes = -(-PASSES // len(views))
    for view in views:
        leaf = logits.clone().requires_grad_(True)
        values = {name: getattr(splats, name) for name in PARAMETERS} | {"opacity_logits": leaf}
        image = render(Splats(**values), view)
        assert image.weight_max is not None
        valid = torch.ones(view.size) if view.valid is None else view.valid
        counted = valid.to(state.device, torch.float32)
        photograph = image.color.detach().clamp(0.0, 1.0)  # which is cut off where the color is brighter than white
        error += float((counted[..., None] * (photograph - view.target) ** 2).sum(dtype=torch.float64))
        weight = torch.maximum(weight, image.weight_max.detach())
        for _ in range(probes):
            drawn = torch.randint(0, 2, image.color.shape, generator=generator, dtype=torch.int8)
            signs = drawn.to(image.color).mul_(2.0).sub_(1.0)
            # of a sum: given the gradient of an image, PyTorch loads its symbolic shapes, which takes .4 s
            signed = (image.color * (counted[..., None] * signs)).sum()
            (slope,) = torch.autograd.grad(signed, [leaf], retain_graph=True)
            total += (slope / (1.0 - opacity)).to(torch.float64) ** 2 / probes  # dC/dlogit = o (1 - o) dC/do
        # an image says nothing of what it shows behind its mask alone
        seen += image.visible if view.valid is None else image.visible & ((slope != 0) | (image.weight_max == 0))
        del image, signed, slope  # with what the rasterizer keeps for them, which the next view takes over
    shown = (seen > 0) & (weight >= HIDDEN * opacity)
    cost = total * len(views) / seen.clamp(min=1.0)
    return torch.where(shown & torch.isfinite(cost), cost, math.inf), error
