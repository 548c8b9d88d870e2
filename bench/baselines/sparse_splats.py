"""Offline 3D Gaussian splatting from sparse points, by our rasterizer and optimizer: a map without dense depth.

Kerbl et al. 2023: one isotropic splat a point, as large as the mean distance to its three nearest, opacity 0.1; random
views at full resolution; clone, split and prune. No opacity reset, as in the online mapper, whose thresholds it shares.
Where a view has an exposure, what the map needs beside it is trained; a view that is only rendered has of that what its
neighbors in time have.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.evaluation.exposure import frame_exposures
from mvsgs_core.mapping.background import Background
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.exposure import ImageFormation
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.optimizer import BETA_1, BETA_2
from mvsgs_core.mapping.trainer import Trainer
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.spherical_harmonics import C0
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats

EXPOSURE_RATE = 1e-3  # learning rate of a view's affine


@dataclass(frozen=True)
class SparseConfig:
    """Offline optimization."""

    seconds: float = 60.0  # of optimization, of the processor
    iterations: int | None = None  # of optimization, whatever the time; None: as many as the seconds allow
    settle: float = 0.5  # last fraction of it, in which learning rates fall to a tenth
    grow: float = 0.5  # first fraction of it, in which splats are added
    initial_opacity: float = 0.1
    mapper: MapperConfig = field(default_factory=MapperConfig)  # training, optimizer, density control, seed, threads


@dataclass(frozen=True)
class Posed:
    """A photograph (H, W, 3) uint8 with its pose (4, 4), in the frame of the points."""

    index: int
    image: np.ndarray
    intrinsics: np.ndarray
    world_from_cam: np.ndarray
    timestamp: float = 0.0  # seconds
    exposure: np.ndarray | None = (
        None  # (3, 4) color affine that is known of it; None: the map's colors are the image's
    )


class SparseMap:
    """The map of sparse points. All lengths inside are relative to the median depth of the points."""

    def __init__(
        self, views: list[Posed], points: np.ndarray, colors: np.ndarray, config: SparseConfig,
        vignetting: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """points (M, 3), colors (M, 3) uint8, vignetting (3,) of the camera if it is known. Raises ValueError without a
        view, or with fewer than 4 points."""
        if not views or len(points) < 4:
            raise ValueError(f"{len(views)} views and {len(points)} points are no start")
        self.config = config
        self.origin = views[0].world_from_cam[:3, 3].copy()
        self.unit = _median_depth(views, points)
        self.state = MapState(1, torch.device("cpu"))
        self._photometry = ImageFormation(vignetting=vignetting)
        self._trainer = Trainer(config.mapper, self.state, Stats(), self._photometry)
        self.seconds = 0.0
        self._random = np.random.default_rng(config.mapper.seed)
        self._given = views
        self._views = [self._training(view) for view in views]
        self._moments = {view.index: torch.zeros(2, 3, 4) for view in views}  # of their exposures
        self._trainer.background = Background(self._views).color
        start = _splats((points - self.origin) / self.unit, colors, config.initial_opacity)
        self.state.append(start, torch.zeros(len(start), dtype=torch.int64))

    @property
    def iterations(self) -> int:
        return self._trainer.iterations

    def optimize(self) -> None:
        """As long as the configuration says."""
        if self.config.mapper.threads:
            torch.set_num_threads(self.config.mapper.threads)  # one more that only waits would count as processor time
        order: list[int] = []
        start = time.process_time()
        while (done := self._done(time.process_time() - start)) < 1.0:
            order = order or [int(i) for i in self._random.permutation(len(self._views))]
            self._step(self._views[order.pop()], done)
        self.seconds += time.process_time() - start

    def render(self, view: Posed) -> np.ndarray:
        """Color (H, W, 3) float32 in 0..1."""
        found = self.exposure_of(view)
        exposure = None if found is None else torch.from_numpy(found)
        with torch.no_grad():
            color = rasterize(
                self.state.detached(), self._local(view.world_from_cam), view.intrinsics, view.image.shape[:2],
                background=self._trainer.background, exposure=exposure, kernel=self.config.mapper.training.kernel,
                threads=self.config.mapper.threads, antialiased=self.config.mapper.training.antialiased,
            ).color  # fmt: skip
        image = color.numpy()
        if self._photometry.vignetting is not None:
            factor = vignetting_factor(self._photometry.vignetting, view.intrinsics, view.image.shape[:2])
            image = image * factor[..., None]
        return np.asarray(np.clip(image, 0.0, 1.0))

    def exposure_of(self, view: Posed) -> np.ndarray | None:
        """(3, 4) float32: what is known of a view's exposure, and what was trained beside it, as that of the training
        views before and after it in time. None where nothing is known."""
        if view.exposure is None:
            return None
        known = [(v.timestamp, v.exposure, t) for v, t in zip(self._given, self._views) if v.exposure is not None]
        times = np.array([view.timestamp, *(time for time, _, _ in known)])
        measured = np.stack([view.exposure, *(exposure for _, exposure, _ in known)])
        trained = np.stack([t.exposure.detach().numpy() for _, _, t in known])
        order = np.argsort(times, kind="stable")
        place = np.argsort(order)
        rows = np.sort(place[1:])
        found = frame_exposures(times[order], measured[order], rows, trained[order[rows] - 1])
        return None if found is None else found[place[0]]

    def _done(self, seconds: float) -> float:
        """Share of the work."""
        wanted = self.config.iterations
        return seconds / self.config.seconds if wanted is None else self.iterations / wanted

    def _step(self, view: TrainingView, done: float) -> None:
        settling = max(0.0, (done - 1.0 + self.config.settle) / self.config.settle)
        self._trainer.rate = 0.1**settling
        self._trainer.step(view, 1.0, refining=done > self.config.grow)
        _step_exposure(view, self._moments[view.index])

    def _training(self, view: Posed) -> TrainingView:
        unknown = np.zeros(view.image.shape[:2], dtype=np.float32)
        posed = RGBDKeyframe(view.index, view.image, view.intrinsics, view.world_from_cam, unknown)
        training = training_view(posed, self._local(view.world_from_cam), None, self.state.device)
        if view.exposure is not None:
            training.take_exposure(view.exposure.astype(np.float32))
            training.exposure.requires_grad_()
        return training

    def _local(self, world_from_cam: np.ndarray) -> np.ndarray:
        local = world_from_cam.copy()
        local[:3, 3] = (local[:3, 3] - self.origin) / self.unit
        return local


@torch.no_grad()
def _step_exposure(view: TrainingView, moments: Tensor) -> None:
    """Adam on the affine of a view that has a known one, drawn toward that. moments: (2, 3, 4)."""
    gradient, view.exposure.grad = view.exposure.grad, None
    if gradient is None or view.measured is None or not bool(torch.isfinite(gradient).all()):
        return
    gradient = gradient + 1e-3 * (view.exposure - torch.from_numpy(view.measured))
    first, second = moments
    first.mul_(BETA_1).add_(gradient, alpha=1 - BETA_1)
    second.mul_(BETA_2).addcmul_(gradient, gradient, value=1 - BETA_2)
    mean, square = first / (1 - BETA_1**view.visits), second / (1 - BETA_2**view.visits)
    view.exposure -= EXPOSURE_RATE * mean / (square.sqrt() + 1e-8)


def _median_depth(views: list[Posed], points: np.ndarray) -> float:
    depths = [(points - v.world_from_cam[:3, 3]) @ v.world_from_cam[:3, 2] for v in views]
    seen = np.concatenate(depths)
    return float(np.median(seen[seen > 0]))


def _splats(points: np.ndarray, colors: np.ndarray, opacity: float) -> Splats:
    """Isotropic splats at points (M, 3), M at least 4."""
    count = len(points)
    positions = torch.from_numpy(points)
    spacing = torch.cat([  # mean squared distance to the three nearest, itself left out
        torch.cdist(rows, positions).topk(4, largest=False).values[:, 1:].square().mean(dim=1)
        for rows in positions.split(1024)
    ]).clamp(min=1e-10).sqrt()  # fmt: skip
    return Splats(
        means=positions.float(),
        log_scales=spacing.log().float()[:, None].repeat(1, 3),
        quaternions=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        sh=torch.from_numpy(((colors / 255.0 - 0.5) / C0).astype(np.float32))[:, None, :],
        betas=torch.full((count,), 2.0),
    )
