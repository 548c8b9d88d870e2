"""The online mapper: keyframes with depth in, a map of splats that is optimized between them and refined at the end.

MVS-GS, section III.C. All state is in the mapper's own frame: world coordinates relative to the first keyframe's
position, in units of its median depth, so that float32 holds wherever the world's origin and scale are.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping import density_control, optimizer
from mvsgs_core.mapping.deformation import Similarity, move_with_anchors
from mvsgs_core.mapping.densifier import Densifier, checked_depth
from mvsgs_core.mapping.density_control import DensityControlConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframe_checks import MAX_DEPTH, NO_POSE, checked_keyframe, is_near, is_pose
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.optimizer import OptimizerConfig
from mvsgs_core.mapping.schedule import Schedule
from mvsgs_core.mapping.self_check import SelfCheck, check
from mvsgs_core.mapping.snapshot import snapshot
from mvsgs_core.mapping.training import SkipConfig, TrainingConfig, train_once
from mvsgs_core.rasterizer.rasterize import Render, rasterize
from mvsgs_core.stats import Stats


@dataclass(frozen=True)
class MapperConfig:
    """The mapper's parameters; lengths are relative to the scene's median depth."""

    iterations: int = 30  # owed for each keyframe, half on the local window, half on all (the paper: 1,000)
    refinement: int = 300  # iterations over all keyframes after the last
    window: int = 6  # newest keyframes that the local half trains on
    realtime: bool = False  # a new keyframe cancels what older ones are owed
    max_pixels: int | None = None  # area of the training images; None: as they come
    max_keyframes: int = 1000  # whose images are kept and trained on; beyond, they are thinned out evenly
    sh_degree: int = 0  # 0 to 3
    seed: int = 0
    device: str = "cpu"
    training: TrainingConfig = field(default_factory=TrainingConfig)
    skipping: SkipConfig = field(default_factory=SkipConfig)
    rates: OptimizerConfig = field(default_factory=OptimizerConfig)
    insertion: InsertionConfig = field(default_factory=InsertionConfig)
    density_control: DensityControlConfig = field(default_factory=DensityControlConfig)


class OnlineMapper:
    """Builds the map: `add_keyframe`, then `step` while pending, `correct` at any time, `refine` last."""

    def __init__(
        self,
        config: MapperConfig | None = None,
        log: Stats | None = None,
        corrections: dict[int, tuple[np.ndarray, float]] | None = None,
    ) -> None:
        """log, corrections (world_from_cam (4, 4), scale; by keyframe): what mappers of one stream share."""
        self.config = config or MapperConfig()
        self.state = MapState((self.config.sh_degree + 1) ** 2, torch.device(self.config.device))
        self.views: list[TrainingView] = []
        self.with_image: list[TrainingView] = []  # those of them that are trained on
        self.schedule = Schedule(self.config.window, self.config.seed)
        self.log = log or Stats()
        self.iterations = 0
        self.origin: np.ndarray | None = None  # (3,) float64 world position of the first keyframe
        self.unit: float | None = None  # median depth of the first keyframe that has depth, world units
        self.global_rate = 1.0  # factor on all learning rates: falls during refinement
        self.corrections = {} if corrections is None else corrections  # newest pose and scale of each keyframe
        self.generator = torch.Generator().manual_seed(self.config.seed)

    @property
    def median_depth(self) -> float:
        """Of the scene, in the mapper's unit: what lengths are related to."""
        known = [view.median_depth for view in self.views if view.median_depth > 0]
        return float(np.median(known)) if known else 1.0

    def add_keyframe(self, view: RGBDKeyframe) -> int:
        """Takes in a keyframe and adds splats where the map does not explain it; returns their number.

        Without `realtime`, what earlier keyframes are owed is done first, so that the result does not depend on how
        fast keyframes come. A view that no camera gives is refused and counted, see `keyframe_checks`.
        """
        if self.config.realtime:
            self.log.skip("iterations_realtime", self.schedule.drop())
        else:
            while self.step():
                pass
        checked = checked_keyframe(view, self.log)
        return 0 if checked is None else self._take_in(checked)

    def _take_in(self, view: RGBDKeyframe) -> int:
        depth = checked_depth(view.depth, self.log)
        pose, scale = self.corrections.get(view.index, (np.asarray(view.world_from_cam, dtype=np.float64), view.scale))
        depth = depth * np.float32(scale / view.scale)
        median = _median(depth)
        if median == 0 and view.unfiltered is not None:  # the filters kept nothing: doubtful depth gives the scale
            median = _median(view.unfiltered) * scale / view.scale
        if median >= MAX_DEPTH or (self.unit is not None and not is_near(self.local(pose)[:3, 3], median / self.unit)):
            self.log.refuse("views", 1, "a keyframe far away from all others, or with depth so large, was refused")
            return 0
        if self.origin is None:
            self.origin = pose[:3, 3].copy()
        if self.unit is None and median > 0:
            self.unit = median
            for earlier in self.views:
                earlier.local_from_cam = self.local(earlier.world_from_cam)
        added = training_view(
            view, self.local(pose), self.config.max_pixels, self.config.skipping.levels, self.state.device
        )
        added.world_from_cam, added.scale, added.median_depth = pose, scale, median / (self.unit or 1.0)
        added.fixed = not self.views
        self.views.append(added)
        self.with_image.append(added)
        self._bound_images()
        if added.valid is not None:
            self.log.refuse(
                "pixels", int((~added.valid[0]).sum()), "pixels that are not finite were left out of the training"
            )
        with self.log.time("insertion"):
            densifier = self._densifier()
            if self.config.training.exposure:
                densifier.expose(added, self.views[-2] if len(self.views) > 1 else None)
            inserted = densifier.insert(view, added, depth) if (depth > 0).any() else 0
            inserted += densifier.fill(view, added)
        self.schedule.add_budget(self.config.iterations)
        self.log.count("inserted", inserted)
        self.log.count("views")
        self.log.count("views_without_depth", float(not (depth > 0).any()))
        return inserted

    def step(self) -> bool:
        """One owed iteration; False when nothing is owed."""
        if self.schedule.pending == 0 or not self.views or len(self.state) == 0:
            self.schedule.drop()
            return False
        with self.log.time("optimization"):
            view = self.with_image[self.schedule.next(len(self.with_image))]
            skip = self.config.skipping
            done = skip.converged and view.converged(skip.converged_visits, skip.converged_improvement)
            if done and not self.schedule.chance(skip.converged_keep):
                self.log.skip("iterations_converged")
                return True
            self._train(view)
        return True

    def refine(self, done: int, total: int) -> None:
        """Iteration `done` of `total` of the final refinement: any keyframe, full resolution, falling rates."""
        if not self.views or len(self.state) == 0:
            return
        with self.log.time("refinement"):
            self.global_rate = 0.1 ** (done / max(total, 1))
            self._train(self.with_image[self.schedule.next_of_all(len(self.with_image))], refining=True)

    def correct(self, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray) -> int:
        """Takes corrected absolute poses (K, 4, 4) and cumulative scales (K,) of the keyframes `index` (K,).

        Splats move with their anchor keyframe; returns how many did. Poses that are not finite are refused and counted.
        """
        moved: dict[int, Similarity] = {}
        by_index = {view.index: view for view in self.views}
        for key, pose, s in zip(index.tolist(), np.asarray(world_from_cam, dtype=np.float64), scale.tolist()):
            if not is_pose(pose, s) or (self.unit is not None and not is_near(self.local(pose)[:3, 3])):
                self.log.refuse("poses", 1, NO_POSE)
                continue
            self.corrections[key] = (pose, s)
            view = by_index.get(key)
            if view is None:
                continue
            similarity = Similarity.between(view.local_from_cam, self.local(pose), s / view.scale)
            view.world_from_cam, view.local_from_cam = pose, self.local(pose)
            view.rescale(s / view.scale)
            view.scale = s
            if similarity.moves(max(view.median_depth, 1e-6)):
                moved[key] = similarity
                view.loss_fast = view.loss_slow = float("nan")
                view.visits_full = 0
        with self.log.time("correction"):
            count = move_with_anchors(self.state, moved)
        self.log.count("corrected_keyframes", len(moved))
        return count

    def join(self, other: OnlineMapper) -> None:
        """Takes over the map of another part of the stream, of the same configuration, whose poses `correct` brought
        into this one's frame of reference.

        Splats, keyframes, moments, exposures, pose steps and what is owed go on as they were, in this mapper's origin
        and unit; `other` is of no use afterward.
        """
        if other.origin is None:
            return
        if self.origin is None:
            self.origin = other.origin
        if self.unit is None and other.unit is not None:
            self.unit = other.unit
            for view in self.views:
                view.local_from_cam = self.local(view.world_from_cam)
        unit, other_unit = self.unit or 1.0, other.unit or 1.0
        change = Similarity(other_unit / unit, np.eye(3), (other.origin - self.origin) / unit)
        with self.log.time("joining"):
            move_with_anchors(other.state, dict.fromkeys(other.state.anchors.unique().tolist(), change))
            self.state.take_over(other.state)
        for view in other.views:
            view.local_from_cam = self.local(view.world_from_cam)
            view.rescale(change.scale)
            view.fixed = view.fixed and not self.views  # one holds the frame of reference
        self.views = sorted(self.views + other.views, key=lambda view: view.index)
        self.with_image = sorted(self.with_image + other.with_image, key=lambda view: view.index)
        self._bound_images()
        self.schedule.reset()
        self.schedule.add_budget(other.schedule.drop())
        self.iterations += other.iterations

    def render(self, view: TrainingView, level: int = 0) -> Render:
        """The map from a keyframe's pose, without gradients."""
        with torch.no_grad():
            return rasterize(
                self.state.detached(), view.refined_from_cam, view.intrinsics[level], view.size(level),
                kernel=self.config.training.kernel, near=self.config.training.near * self.median_depth,
                backend=self.config.training.backend, exposure=view.exposure if self.config.training.exposure else None,
                antialiased=self.config.training.antialiased, threads=self.config.training.threads,
            )  # fmt: skip

    def self_check(self, most: int = 20) -> SelfCheck | None:
        """How well the map explains its keyframes, `most` of them, spread over the stream; None without any."""
        views = self.with_image[:: -(-len(self.with_image) // most) or 1]
        return check([(self.render(v).color.clamp(0.0, 1.0).cpu().numpy(), v.target(0).cpu().numpy()) for v in views])

    def snapshot(self) -> Snapshot:
        """The map in world units, relative to its origin."""
        return snapshot(self.state, self.views, self.origin, self.unit, self.config.training.kernel, self.iterations)

    @property
    def image_bytes(self) -> int:
        """Of the keyframes' images that are kept for training: what grows with the length of a run, to a bound."""
        return sum(level.numel() for view in self.with_image for level in view.levels)

    def _bound_images(self) -> None:
        """Lets go the images of the keyframes whose neighbors in time are closest, where there are too many.

        The newest ones, which the local half trains on, stay. Their splats stay, and move with their poses.
        """
        while len(self.with_image) > self.config.max_keyframes:
            last = len(self.with_image) - max(1, self.config.window)
            if last < 2:
                return
            order = [view.index for view in self.with_image]
            k = min(range(1, last), key=lambda k: order[k + 1] - order[k - 1])
            self.with_image.pop(k).drop_images()
            self.schedule.reset()
            self.log.refuse(
                "images",
                1,
                f"more than {self.config.max_keyframes} keyframes (max_keyframes): images of "
                "older ones are thinned out and no longer trained on",
            )

    def _train(self, view: TrainingView, refining: bool = False) -> None:
        config = self.config
        factors = optimizer.groups(
            config.rates, self.median_depth, self.global_rate, config.training.betas, config.training.kernel
        )
        train_once(
            self.state, view, config.training, config.skipping, factors, config.rates.decay_steps,
            self.median_depth, self.global_rate, refining, self.log,
        )  # fmt: skip
        self.iterations += 1
        self.log.count("iterations")
        if not refining and self.iterations % config.density_control.every == 0:
            with self.log.time("density_control"):
                change = density_control.control(self.state, config.density_control, self.median_depth, self.generator)
            for name, count in vars(change).items():
                self.log.count(name, count)

    def _densifier(self) -> Densifier:
        config = self.config
        return Densifier(
            config.insertion, config.training, config.density_control.max_splats, self.state, self.render,
            self.unit, self.median_depth, self.log,
        )  # fmt: skip

    def local(self, world_from_cam: np.ndarray) -> np.ndarray:
        local = world_from_cam.copy()
        local[:3, 3] = (local[:3, 3] - self.origin) / (self.unit or 1.0)
        return local


def _median(depth: np.ndarray) -> float:
    """Of the depths that are known, 0 where none is."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(known)) if len(known) else 0.0
