"""One training iteration: render a keyframe, compare, step what was seen; and what an iteration leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch

from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.camera_optimizer import step_exposure, step_pose
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.losses import LossConfig, frequency_of, photometric_loss
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.rasterize import rasterize


@dataclass(frozen=True)
class TrainingConfig:
    """What is rendered and trained."""

    kernel: str = "gaussian"  # "gaussian", "exact" or "ges_scale"
    betas: bool = False  # train the shape; without effect for kernel "gaussian"
    exposure: bool = False  # train a color affine for each keyframe
    exposure_rate: float = 1e-3  # learning rate of it
    poses: bool = False  # train the keyframes' poses, the first one's excepted
    pose_rate: float = 4e-5  # learning rate of them, radians and median depths a step
    pose_visits: int = 5  # iterations on a keyframe before its pose is trained: new splats show nothing new
    antialiased: bool = False
    near: float = 1e-3  # splats nearer than this many median depths are left out
    backend: str = "auto"
    threads: int | None = None  # None: all
    loss: LossConfig = field(default_factory=lambda: LossConfig(l1=0.8, ssim=0.2, frequency=0.0))  # as 3DGS
    frequency_horizon: int = 60  # visits of a keyframe over which the frequency-modulated mask runs through its bands


@dataclass(frozen=True)
class SkipConfig:
    """What the optimization leaves out, each with its switch."""

    converged: bool = True  # keyframes whose loss no longer falls are mostly passed over
    converged_visits: int = 30  # full-resolution visits before a keyframe can count as converged
    converged_improvement: float = 0.02  # share by which the loss must still fall
    converged_keep: float = 0.5  # share of the visits that a converged keyframe still gets
    coarse_to_fine: bool = False  # the first visits of a keyframe are at lower resolution
    coarse_visits: int = 2  # of these, for each level
    levels: int = 2  # of the image pyramid, full resolution included
    selective: bool = True  # only splats that were seen are stepped


class Log(Protocol):
    """What an iteration counts into."""

    def count(self, name: str, n: float = 1) -> None: ...

    def skip(self, what: str, n: float = 1) -> None: ...

    def refuse(self, name: str, n: float, text: str) -> None: ...


def level_of_visit(view: TrainingView, skipping: SkipConfig) -> int:
    """Pyramid level of a view's next visit: coarse first."""
    if not skipping.coarse_to_fine:
        return 0
    return max(0, len(view.levels) - 1 - view.visits // skipping.coarse_visits)


def train_once(
    state: MapState,
    view: TrainingView,
    training: TrainingConfig,
    skipping: SkipConfig,
    groups: list[optimizer.Group],
    decay_steps: int,
    median_depth: float,
    global_rate: float,
    refining: bool,
    log: Log,
) -> None:
    """One iteration on `view`. What is not finite is refused, counted in `log`, and never reaches the map."""
    level = 0 if refining else level_of_visit(view, skipping)
    exposure = view.exposure.requires_grad_(True) if training.exposure else None
    moving = training.poses and not view.fixed and view.visits >= training.pose_visits
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True) if moving else None
    render = rasterize(
        state.splats, view.refined_from_cam, view.intrinsics[level], view.size(level), kernel=training.kernel,
        backend=training.backend, exposure=exposure, pose_delta=twist, near=training.near * median_depth,
        antialiased=training.antialiased, threads=training.threads,
    )  # fmt: skip
    target = view.target(level)
    if view.valid is not None:
        target = torch.where(view.valid[level][..., None], target, render.color.detach())
    frequency = frequency_of(view.visits, training.frequency_horizon)
    loss = photometric_loss(render.color, target, frequency, training.loss, training.threads)
    view.visits += 1
    value = float(loss.detach())
    if not value < float("inf"):
        optimizer.clear_gradients(state)
        log.refuse("iterations", 1, "an iteration whose loss was not finite was refused")
        return
    loss.backward()
    if render.backward.refused:
        text = "gradients of splats that were not finite were set to 0 in the rasterizer's backward pass"
        log.refuse("gradients", render.backward.refused, text)
    if render.means2d.grad is not None:
        gradient = render.means2d.grad.norm(dim=1)
        state.accumulate_means2d(torch.where(torch.isfinite(gradient), gradient, 0.0), render.visible)
    visible = render.visible if skipping.selective else torch.ones_like(render.visible)
    refused = optimizer.step(state, visible, groups, decay_steps, training.threads or 0)
    if refused:
        log.refuse("steps", refused, "steps of splats with gradients that are not finite were refused")
    if skipping.selective:
        log.skip("splats_unseen", len(state) - int(visible.sum()))
    if exposure is not None:
        step_exposure(view, training.exposure_rate)
    if twist is not None and twist.grad is not None:
        rate = training.pose_rate * global_rate
        if not step_pose(view, twist.grad.numpy(), rate, rate * median_depth):
            log.refuse("pose_steps", 1, "a step of a keyframe's pose that was not finite was refused")
    if level == 0:
        view.record(value)
