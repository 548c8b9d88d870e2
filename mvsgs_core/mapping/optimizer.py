"""Selective Adam for an online map: only what was seen is stepped, each splat by its own age, never to NaN or Inf."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mvsgs_core import native
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.rasterizer.interface import Moved, SplatStep
from mvsgs_core.setting_ranges import at_least, within

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15


@dataclass(frozen=True)
class OptimizerConfig:
    """Rates of a splat's parameters. Lengths are in units of the scene's median depth.

    Raises ValueError for a `max_scale` that no splat has, and for a `max_scale_in_stream` that is no part of it.
    """

    means: float = 1.0e-3  # median depths a step, for a new splat
    means_final: float = 0.05  # fraction of `means` that an old splat keeps
    decay_steps: int = 600  # steps of a splat until then, log-linear
    log_scales: float = 0.1  # natural logarithm a step
    max_scale: float = 0.2  # median depths: the widest standard deviation; wider, it is fog to a camera that comes near
    # of `max_scale`, before the refinement, when few views tell where a splat belongs; what a new one may have at least
    max_scale_in_stream: float = 0.25
    quaternions: float = 0.015  # a step, of a unit quaternion
    opacity_logits: float = 0.05  # logit a step
    sh: float = 0.03  # color a step, degree 0; higher degrees a twentieth
    betas: float = 1.0e-3  # shape exponent a step

    def __post_init__(self) -> None:
        at_least(self, means=0, decay_steps=0, log_scales=0, quaternions=0, opacity_logits=0, sh=0, betas=0)
        within(self, means_final=(0, 1))
        if not 1e-5 <= self.max_scale <= 1e5:
            raise ValueError(f"mapper.optimizer.max_scale={self.max_scale}: median depths, from 1e-5 to 1e5")
        if not 1e-3 <= self.max_scale_in_stream <= 1.0:
            raise ValueError(
                f"mapper.optimizer.max_scale_in_stream={self.max_scale_in_stream}: a part of max_scale, from 0.001 to 1"
            )


@dataclass(frozen=True)
class Group:
    """One parameter's step: it takes no value beyond `low` and `high`, which is what keeps wild rates finite. What is
    beyond them already goes no further."""

    name: str
    rate: float
    final_rate: float
    low: float
    high: float
    lead: int = 48  # columns of the flattened parameter that take the full rate,
    tail: float = 1.0  # the others this fraction of it


def groups(
    rates: OptimizerConfig, median_depth: float, factor: float, train_betas: bool, kernel: str, *,
    widest_new: float | None = None,
) -> list[Group]:  # fmt: skip
    """The steps of all parameters for a scene of this median depth; `factor` scales all rates (the global decay).

    widest_new: median depths, the standard deviation that a new splat may have in a stream, where none may yet grow
    as wide as in the refinement; None: in that.
    """
    log_depth = math.log(median_depth)
    widest = rates.max_scale
    if widest_new is not None:
        widest = min(widest, max(widest * rates.max_scale_in_stream, widest_new))
    largest = log_depth + math.log(widest)
    means = rates.means * median_depth * factor
    beta_range = (-60.0, 60.0) if kernel == "ges_scale" else (0.1, 20.0)
    result = [
        Group("means", means, means * rates.means_final, -1e6 * median_depth, 1e6 * median_depth),
        Group("log_scales", rates.log_scales * factor, rates.log_scales * factor, log_depth - 14.0, largest),
        Group("quaternions", rates.quaternions * factor, rates.quaternions * factor, -1e3, 1e3),
        Group("opacity_logits", rates.opacity_logits * factor, rates.opacity_logits * factor, -12.0, 12.0),
        Group("sh", rates.sh * factor, rates.sh * factor, -100.0, 100.0, lead=3, tail=0.05),
    ]
    if train_betas:
        result.append(Group("betas", rates.betas * factor, rates.betas * factor, *beta_range))
    return result


def step(state: MapState, visible: Tensor, steps: list[Group], decay_steps: int, threads: int = 0) -> int:
    """One Adam step of the `visible` (N,) bool splats from the gradients on `state.splats`; clears the gradients.

    Returns the number of splats refused: a non-finite gradient, or a step that would give a non-finite value, leaves
    the whole splat (or that parameter and its moments) as it was. The kernel runs on the CPU, its PyTorch twin,
    `step_reference`, elsewhere. Kingma and Ba 2015, algorithm 1, with one step count a splat.
    """
    if len(state) == 0:
        return 0
    if state.device.type != "cpu":
        return step_reference(state, visible, steps, decay_steps)
    groups = []
    for group in steps:
        parameter: Tensor = getattr(state.splats, group.name)
        if parameter.grad is None:
            continue
        rows = (parameter.detach(), parameter.grad, state.first[group.name], state.second[group.name])
        arrays = [value.reshape(len(state), -1).numpy() for value in rows]
        groups.append((*arrays, group.rate, group.final_rate, group.low, group.high, group.lead, group.tail))
    if not groups:
        return 0
    refused: int = native.load("mapping").adam(
        groups, visible.numpy(), state.steps.numpy(), BETA_1, BETA_2, EPSILON, decay_steps,
        threads or torch.get_num_threads(),
    )  # fmt: skip
    clear_gradients(state)
    return refused


def splat_step(state: MapState, steps: list[Group], decay_steps: int) -> SplatStep:
    """The same step, with what density control decides on, for a backward pass to take: no gradient is then stored and
    read again."""
    moved = [Moved(first=state.first[g.name], second=state.second[g.name], **vars(g)) for g in steps]
    return SplatStep(
        moved, state.steps, state.means2d_gradient, state.means2d_views, (BETA_1, BETA_2, EPSILON), decay_steps
    )


@torch.no_grad()
def step_reference(state: MapState, visible: Tensor, steps: list[Group], decay_steps: int) -> int:
    """The same in PyTorch: what runs on a GPU, and what the kernel's test compares with."""
    active = [group for group in steps if getattr(state.splats, group.name).grad is not None]
    taken = visible.clone()
    for group in active:
        gradient = getattr(state.splats, group.name).grad.reshape(len(state), -1)
        taken &= torch.isfinite(gradient.abs().sum(dim=1))
    refused = visible & ~taken
    state.steps += taken.to(torch.int32)
    age = state.steps.to(torch.float64).clamp(min=1)[:, None]
    progress = (age / max(decay_steps, 1)).clamp(max=1.0).float()
    # float32 would lose 1 - beta^age; all else is in it, as in the kernel: most GPUs take 64 times as long for float64
    correction_1, correction_2 = ((1.0 / (1.0 - beta**age)).float() for beta in (BETA_1, BETA_2))
    for group in active:
        parameter: Tensor = getattr(state.splats, group.name)
        value = parameter.detach().reshape(len(state), -1)
        gradient = parameter.grad.reshape(len(state), -1)  # type: ignore[union-attr]  # active groups have one
        first = state.first[group.name].reshape(len(state), -1)
        second = state.second[group.name].reshape(len(state), -1)
        m = BETA_1 * first + (1 - BETA_1) * gradient
        v = BETA_2 * second + (1 - BETA_2) * gradient * gradient
        rate = group.rate * (group.final_rate / group.rate) ** progress if group.rate > 0 else 0.0
        column = torch.arange(value.shape[1], device=value.device)
        rate = rate * torch.where(column < group.lead, 1.0, group.tail)
        update = rate * (m * correction_1) / ((v * correction_2).sqrt() + EPSILON)
        low, high = value.clamp(max=group.low), value.clamp(min=group.high)
        stepped = torch.minimum(torch.maximum(value - update, low), high)
        finite = torch.isfinite(stepped.abs().sum(dim=1) + m.abs().sum(dim=1) + v.sum(dim=1))
        refused |= taken & ~finite
        rows = (taken & finite)[:, None]
        value.copy_(torch.where(rows, stepped, value))
        first.copy_(torch.where(rows, m, first))
        second.copy_(torch.where(rows, v, second))
    clear_gradients(state)
    return int(refused.sum())


def clear_gradients(state: MapState) -> None:
    for name in PARAMETERS:
        getattr(state.splats, name).grad = None
