"""One training iteration: render a keyframe, compare, step what was seen; and every so often density control."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.mapping import density_control, losses, optimizer
from mvsgs_core.mapping.camera_optimizer import step_pose
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.exposure import ImageFormation
from mvsgs_core.mapping.free_space import in_the_air
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.losses import (
    LossInputs,
    frequency_of,
    loss_function,
    only_photometric,
    own_loss,
    training_loss,
    weights_of,
)
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.partition import LEVELS
from mvsgs_core.mapping.pruning import bound, prune
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.interface import SplatStep
from mvsgs_core.rasterizer.photograph_loss import Formation, photograph_loss
from mvsgs_core.rasterizer.rasterize import Render, chosen_backend, rasterize
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats

FINAL_RATE = 0.1  # of the learning rates, with which a map is handed out
UNSURE = 0.01  # standard deviation of the background in training: no splat can leave its own color to it
WIDEST_NEW = 2 << LEVELS  # pixels of a side that a new splat may stand for: the largest rectangle at half the size
FACTORS = 8  # images of vignetting that are kept, one for each size and intrinsics


class Trainer:
    """Optimizes the splats of a map, and the cameras of its keyframes, by one keyframe an iteration.

    What is not finite is refused, counted in the log, and never reaches the map.
    """

    def __init__(
        self, config: MapperConfig, state: MapState, log: Stats, photometry: ImageFormation | None = None
    ) -> None:
        """photometry: None: no camera is known to have an exposure."""
        self.config, self.state, self.log = config, state, log
        self.photometry = ImageFormation() if photometry is None else photometry
        self.iterations = 0
        self.rate = 1.0  # factor on all learning rates: falls during the final refinement
        self.background: np.ndarray | None = None  # (3,) behind the splats, in the map's colors; None: black
        self.generator = torch.Generator().manual_seed(config.seed)  # of density control and backgrounds
        self._factors: dict[tuple[float, ...], Tensor] = {}
        self._weights = weights_of(config.training.loss, config.training.loss_weights)
        own = config.training.loss_function
        self._own_loss = None if own is None else loss_function(own)

    def render(self, view: TrainingView, median_depth: float, size: tuple[int, int] | None = None) -> Render:
        """The map as a keyframe's camera photographs it, without gradients. size: height, width; None: the training
        image's."""
        intrinsics = view.intrinsics if size is None else view.intrinsics_at(size)
        with torch.no_grad():
            render = self._rasterize(self.state.detached(), view, intrinsics, size or view.size, median_depth)
            if self._photographed(view):
                render.color = render.color.clamp(0.0, 1.0)
            return render

    def weights(self, view: TrainingView, median_depth: float) -> Tensor:
        """(N,) the most of a pixel's light that each splat has in a training image."""
        with torch.no_grad():
            found = self._rasterize(
                self.state.detached(), view, view.intrinsics, view.size, median_depth, weights=True, formed=False
            ).weight_max
        assert found is not None
        return found

    def step(self, view: TrainingView, median_depth: float, *, refining: bool = False) -> None:
        """One iteration on a keyframe. median_depth: of the scene; refining: no splat is added or removed, and
        they may grow wider, see `OptimizerConfig`."""
        training = self.config.training
        moving = training.refine_poses and not view.fixed and view.visits >= training.pose_visits
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True) if moving else None
        groups = self._groups(median_depth, None if refining else self._widest_new(view))
        step = self._fused_step(groups)
        at_once = self._own_loss is None and only_photometric(self._weights)
        render = self._rasterize(
            self.state.splats, view, view.intrinsics, view.size, median_depth, twist=twist, step=step,
            formed=not at_once, background=self._unsure_background(),
        )  # fmt: skip
        if at_once:
            loss = self._photograph_loss(view, render)
        else:
            inputs, own = self._loss_inputs(view, render, refining), self._own_loss
            loss = training_loss(inputs, self._weights) if own is None else own_loss(own, inputs)
        view.visits += 1
        value = float(loss.detach())
        if value < float("inf"):
            loss.backward()
            self._step_splats(render, groups, step)
            self._step_camera(view, twist, median_depth)
            view.record(value)
        else:
            optimizer.clear_gradients(self.state)
            self.log.refuse("iterations", 1, "an iteration whose loss was not finite was refused")
        self.iterations += 1
        self.log.count("iterations")
        if not refining and self.iterations % self.config.density_control.every == 0:
            with self.log.time("density_control"):
                change = density_control.control(self.state, self.config.density_control, median_depth, self.generator)
            for name, count in vars(change).items():
                self.log.count(name, count)

    def clear_the_air(self, views: list[TrainingView]) -> None:
        """Removes the splats that lie before what most of these keyframes see, see `free_space`."""
        config = self.config.density_control
        if config.mode == "none" or not config.in_the_air:
            return
        with self.log.time("density_control"):
            removed = in_the_air(self.state.splats.means.detach(), views, config.in_the_air)
            self.log.count("in the air", int(removed.sum()))
            self.state.keep(~removed)

    def prune(self, views: list[TrainingView], median_depth: float) -> None:
        """Removes the splats that the images of these keyframes do without, see `pruning`."""
        config = self.config.density_control
        if config.mode == "none":
            return
        with self.log.time("density_control"):
            generator = torch.Generator().manual_seed(self.config.seed)
            render = self._judged(median_depth)
            self.log.count("needless", prune(self.state, views, render, config.needless, generator))

    def bound(self, views: list[TrainingView], median_depth: float, known: int) -> None:
        """Of a map that has more splats than `max_splats`, and than the `known` that may stay, those go that the images
        of these keyframes miss least."""
        most = max(self.config.density_control.max_splats, known)
        if len(self.state) <= most:
            return
        with self.log.time("density_control"):
            generator = torch.Generator().manual_seed(self.config.seed)
            removed = bound(self.state, views, self._judged(median_depth), most, generator)
        limit = f"max_splats={self.config.density_control.max_splats}"
        text = f"two maps that were joined had more than {limit}: what their images miss least was taken out"
        self.log.refuse("splats", removed, text)

    def _judged(self, median_depth: float) -> Callable[[Splats, TrainingView], Render]:
        """What `pruning` judges splats by."""

        def render(splats: Splats, view: TrainingView) -> Render:
            return self._rasterize(splats, view, view.intrinsics, view.size, median_depth, weights=True)

        return render

    def _rasterize(
        self, splats: Splats, view: TrainingView, intrinsics: np.ndarray, size: tuple[int, int], median_depth: float,
        *, twist: Tensor | None = None, weights: bool = False, step: SplatStep | None = None, formed: bool = True,
        background: np.ndarray | None = None,
    ) -> Render:  # fmt: skip
        """formed: as the camera photographs it, exposure and vignetting done; else the map's own colors. background: in
        the place of the map's."""
        training = self.config.training
        render = rasterize(
            splats, view.refined_from_cam, intrinsics, size, kernel=training.kernel, backend=training.backend,
            background=self.background if background is None else background,
            exposure=_exposure(view) if formed else None, pose_delta=twist, readout=view.readout,
            reads_columns=view.reads_columns, near=training.near * median_depth, antialiased=training.antialiased,
            weights=weights, threads=self.config.threads, step=step,
        )  # fmt: skip
        factor = self._vignetting(intrinsics, size) if formed else None
        if factor is not None:
            render.color = render.color * factor
        return render

    def _unsure_background(self) -> np.ndarray | None:
        """Another one each time: over one that is always the same, splats of about its color stay half transparent."""
        if self.background is None:
            return None
        return self.background + UNSURE * torch.randn(3, generator=self.generator).numpy()

    def _photographed(self, view: TrainingView) -> bool:
        """Whether exposure or vignetting is known: then the image ends at black and white where the color does not."""
        return view.measured is not None or self.photometry.vignetting is not None

    def _vignetting(self, intrinsics: np.ndarray, size: tuple[int, int]) -> Tensor | None:
        """(h, w, 1) factor of an image's colors; None: there is none. Kept, as all images of a camera have the same."""
        vignetting = self.photometry.vignetting
        if vignetting is None:
            return None
        key = (*vignetting.tolist(), *np.asarray(intrinsics).tolist(), *size)
        if key not in self._factors:
            if len(self._factors) >= FACTORS:
                self._factors.clear()
            factor = torch.from_numpy(vignetting_factor(vignetting, intrinsics, size))
            self._factors[key] = factor[..., None].to(self.state.device)
        return self._factors[key]

    def _formation(self, view: TrainingView) -> Formation:
        # where it is photographed, white, or black, says that the color is at least, or most, that
        valid = None if view.valid is None else view.valid.to(self.state.device)  # from disk it comes on the CPU
        vignetting = self._vignetting(view.intrinsics, view.size)
        return Formation(_exposure(view), vignetting, valid, self._photographed(view))

    def _photograph_loss(self, view: TrainingView, render: Render) -> Tensor:
        return photograph_loss(
            render.color, view.image, self._formation(view), l1_weight=self._weights["l1"],
            ssim_weight=self._weights["ssim"], threads=self.config.threads,
        )  # fmt: skip

    def _loss_inputs(self, view: TrainingView, render: Render, refining: bool) -> LossInputs:
        target = self._formation(view).target(view.target, render.color)
        return LossInputs(render, target, self.state.splats, self._frequency(view, refining), self.config.threads)

    def _frequency(self, view: TrainingView, refining: bool) -> float:
        """Of the loss: to 50 in the stream, by what the image has had of a keyframe's budget; to 100 in the refinement.

        How long both are, in an image's iterations, nobody knows before the stream has ended.
        """
        if refining:
            return 50.0 + 50.0 * math.log(self.rate) / math.log(FINAL_RATE)  # by how far the rates have fallen
        return 0.5 * frequency_of(view.visits, self.config.budget)

    def _groups(self, median_depth: float, widest_new: float | None) -> list[optimizer.Group]:
        rates, training = self.config.optimizer, self.config.training
        return optimizer.groups(rates, median_depth, self.rate, training.betas, training.kernel, widest_new=widest_new)

    def _widest_new(self, view: TrainingView) -> float:
        """Standard deviation at the median depth, in units of that."""
        return WIDEST_NEW * self.config.insertion.initial_scale / float(view.intrinsics[:2].min())

    def _fused_step(self, groups: list[optimizer.Group]) -> SplatStep | None:
        """Adam for the backward pass to take; None where gradients are needed: where a kernel or a loss leads them on,
        splats are stepped unseen, or the back end cannot."""
        training, state = self.config.training, self.state
        backend = chosen_backend(training.backend, state.device)
        leads_on = training.kernel == "ges_scale" or self._own_loss is not None or len(losses.TERMS) > 1
        if backend != "cpu" or leads_on or not training.selective:
            return None
        return optimizer.splat_step(state, groups, self.config.optimizer.decay_steps)

    def _step_splats(self, render: Render, groups: list[optimizer.Group], step: SplatStep | None) -> None:
        """Adam on the splats that were seen, by the gradients that the backward pass left, or as it did itself."""
        config, log = self.config, self.log
        if render.backward.refused:
            text = "gradients of splats that were not finite were set to 0 in the rasterizer's backward pass"
            log.refuse("gradients", render.backward.refused, text)
        selective = config.training.selective
        if step is not None:
            refused = step.refused
        else:
            if render.means2d.grad is not None:
                gradient = render.means2d.grad.norm(dim=1).nan_to_num_(0.0, 0.0, 0.0)
                self.state.accumulate_means2d(gradient, render.visible)
            stepped = render.visible if selective else torch.ones_like(render.visible)
            decay_steps, threads = config.optimizer.decay_steps, config.threads or 0
            refused = optimizer.step(self.state, stepped, groups, decay_steps, threads)
        if refused:
            log.refuse("steps", refused, "steps of splats with gradients that are not finite were refused")
        if selective:
            log.skip("splats_unseen", len(self.state) - int(render.visible.sum()))

    def _step_camera(self, view: TrainingView, twist: Tensor | None, median_depth: float) -> None:
        """Adam on the keyframe's pose, where it is trained."""
        training = self.config.training
        if twist is not None and twist.grad is not None:
            angle = training.pose_rate * self.rate
            if not step_pose(view, twist.grad.numpy(), angle, angle * median_depth):
                self.log.refuse("pose_steps", 1, "a step of a keyframe's pose that was not finite was refused")


def _exposure(view: TrainingView) -> Tensor | None:
    """(3, 4) color affine; None: nobody knows any."""
    return None if view.measured is None else view.exposure
