"""Adaptive density control for a map that never stops growing: clone, split, prune.

As in 3DGS (Kerbl et al. 2023), section 5, but opacities are never reset: that needs a rhythm of thousands of iterations
in which the map may be worse, and an online map is looked at all the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.rasterizer.reference import rotation_matrices
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.setting_ranges import at_least, within


@dataclass(frozen=True)
class DensityControlConfig:
    """When and how splats are added and removed during optimization."""

    mode: Literal["adaptive", "none"] = "adaptive"  # adaptive: clone, split and prune
    every: int = 50  # iterations between two rounds, 1 at least
    gradient: float = 6.0e-4  # mean screen gradient, in half image widths, above which a splat is cloned or split
    split_scale: float = 0.01  # standard deviation in median depths above which it is split, not cloned
    prune_opacity: float = 0.02  # 0 to 1; below: removed
    in_the_air: float = 0.1  # of the depth that most keyframes see: splats so much nearer go at the end; 0: none does
    needless: float = 0.02  # of the keyframes' squared error that splats taken out at the end may add; 0: none are
    max_splats: int = 1_000_000  # no growth beyond

    def __post_init__(self) -> None:
        at_least(self, gradient=0, split_scale=0, needless=0, max_splats=1)
        within(self, in_the_air=(0, 1))
        if not 0.0 <= self.prune_opacity <= 1.0:
            raise ValueError(f"mapper.density_control.prune_opacity={self.prune_opacity}: an opacity, from 0 to 1")
        if self.every < 1:
            said = "iterations between two rounds, 1 at least; mode=none is without any"
            raise ValueError(f"mapper.density_control.every={self.every}: {said}")


@dataclass(frozen=True)
class DensityChange:
    """What one round did."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0


@torch.no_grad()
def control(
    state: MapState, config: DensityControlConfig, median_depth: float, generator: torch.Generator
) -> DensityChange:
    """One round on the gradients accumulated since the last; resets them."""
    change = DensityChange()
    if len(state) and config.mode == "adaptive":
        change = _adapt(state, config, median_depth, generator)
    state.reset_means2d()
    return change


def removable(state: MapState, config: DensityControlConfig) -> Tensor:
    """(N,) bool: transparent."""
    least = torch.logit(torch.tensor(config.prune_opacity, dtype=torch.float64))  # of 0 and 1: none and all
    return state.splats.opacity_logits < float(least)


def _adapt(
    state: MapState, config: DensityControlConfig, median_depth: float, generator: torch.Generator
) -> DensityChange:
    mean_gradient = state.means2d_gradient / state.means2d_views.clamp(min=1.0)
    prune = removable(state, config)
    dense = (mean_gradient > config.gradient) & ~prune
    room = max(0, config.max_splats - len(state))
    if int(dense.sum()) > room:  # the worst first
        order = torch.argsort(torch.where(dense, mean_gradient, -1.0), descending=True, stable=True)
        dense = torch.zeros_like(dense)
        dense[order[:room]] = True
    large = state.splats.log_scales.max(dim=1).values > math.log(config.split_scale * median_depth)
    clone, split = dense & ~large, dense & large
    _share_opacity(state, clone)
    clones = _clones(_select(state.detached(), clone), generator)
    clone_anchors, clone_steps = state.anchors[clone], state.steps[clone]
    halves = _halves(_select(state.detached(), split), generator)
    half_anchors = state.anchors[split].repeat(2)
    keep = ~(prune | split)
    state.keep(keep)
    state.append(clones, clone_anchors, clone_steps)
    state.append(halves, half_anchors)
    return DensityChange(cloned=int(clone.sum()), split=int(split.sum()), pruned=int(prune.sum()))


def _share_opacity(state: MapState, chosen: Tensor) -> None:
    """Opacity o becomes 1 - sqrt(1 - o), of which two in the same place blend to o: a clone does not change the render
    (Rota Bulo et al. 2024, section 3.3)."""
    logits = state.splats.opacity_logits
    kept = 1.0 - torch.sigmoid(logits[chosen])
    logits[chosen] = torch.logit((1.0 - kept.sqrt()).clamp(1e-4, 1.0 - 1e-4))


def _clones(splats: Splats, generator: torch.Generator) -> Splats:
    """Copies a little off their place: at the very same one, both would have the same gradients for ever."""
    deviations = splats.log_scales.exp()
    drawn = 0.5 * torch.randn((len(deviations), 3), generator=generator).to(deviations.device) * deviations
    moved = {name: getattr(splats, name) for name in PARAMETERS}
    moved["means"] = splats.means + (rotation_matrices(splats.quaternions) @ drawn[..., None])[..., 0]
    return Splats(**moved)


def _halves(splats: Splats, generator: torch.Generator) -> Splats:
    """Two splats for each, drawn from its density, with standard deviations over 1.6 (3DGS, section 5.2)."""
    deviations = splats.log_scales.exp()
    rotation = rotation_matrices(splats.quaternions)
    drawn = torch.randn((2, len(deviations), 3), generator=generator).to(deviations.device) * deviations
    offsets = (rotation @ drawn[..., None])[..., 0]
    doubled = {name: getattr(splats, name).repeat(2, *[1] * (getattr(splats, name).dim() - 1)) for name in PARAMETERS}
    doubled["means"] = (splats.means + offsets).reshape(-1, 3)
    doubled["log_scales"] = doubled["log_scales"] - math.log(1.6)
    return Splats(**doubled)


def _select(splats: Splats, mask: Tensor) -> Splats:
    return Splats(**{name: getattr(splats, name)[mask] for name in PARAMETERS})
