"""The online mapper: keyframes with depth in, a map of splats that is optimized between them and refined at the end.

MVS-GS, section III.C. A keyframe is checked (`keyframe_checks`), placed in the mapper's frame (`frame_of_reference`),
kept to train on (`keyframe_store`), gets splats (`densifier`) and a budget of iterations (`schedule`, `trainer`).
"""

from __future__ import annotations

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.devices import resolve_device
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.between import BetweenView, FrameBetween, between_view
from mvsgs_core.mapping.coarse import LATER, CoarseKeyframes
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.deformation import move_with_anchors
from mvsgs_core.mapping.densifier import Densifier, checked_depth
from mvsgs_core.mapping.exposure import ImageFormation, recolor_with_anchors
from mvsgs_core.mapping.frame_of_reference import FrameOfReference
from mvsgs_core.mapping.free_space import surface_of
from mvsgs_core.mapping.keyframe_checks import NO_POSE, checked_keyframe, is_pose
from mvsgs_core.mapping.keyframe_store import KeyframeStore
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, median_of_known, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.schedule import Schedule
from mvsgs_core.mapping.self_check import SelfCheck, Shown, check
from mvsgs_core.mapping.snapshot import snapshot
from mvsgs_core.mapping.trainer import FINAL_RATE, Trainer
from mvsgs_core.rasterizer.rasterize import Render
from mvsgs_core.stats import Stats

LATE = 30  # part of the refinement's iterations that a keyframe's late splats bring: 1 / LATE
NONE_NOW = 2  # halvings of an image from which on it gets no splats as it comes


class OnlineMapper:
    """Builds the map: `add_keyframe`, then `step` while any is pending, `correct` at any time, `refine` last."""

    def __init__(
        self, config: MapperConfig | None = None, log: Stats | None = None,
        corrections: dict[int, tuple[np.ndarray, float]] | None = None, state: MapState | None = None,
        views: list[TrainingView] | None = None, between: list[BetweenView] | None = None,
        photometry: ImageFormation | None = None,
    ) -> None:  # fmt: skip
        """log, corrections (world_from_cam (4, 4), scale; by keyframe), photometry: what mappers of one stream share.

        state, views, between: of a mapper that is gone on with.
        """
        self.config = config = config or MapperConfig()
        self.log = log or Stats()
        self.corrections = {} if corrections is None else corrections  # newest pose and scale of each keyframe
        self.photometry = ImageFormation() if photometry is None else photometry
        if state is None:
            state = MapState((config.sh_degree + 1) ** 2, torch.device(resolve_device(config.device)))
        self.state = state
        self.frame = FrameOfReference()
        self.keyframes = KeyframeStore(
            config.max_keyframes, config.window, self.log, views or (), between or (), config.images_in_memory
        )
        self.schedule = Schedule(config.window, config.seed)
        self.trainer = Trainer(config, self.state, self.log, self.photometry)
        self.trainer.background = self.keyframes.background.color
        self.coarse = CoarseKeyframes(self.log)
        trainer, keyframes = self.trainer, self.keyframes

        def render(view: TrainingView, size: tuple[int, int] | None = None) -> Render:
            return trainer.render(view, keyframes.median_depth, size)

        # no part refers to its mapper: copies of it, for checkpoints, are then freed as soon as they are written
        self.densifier = Densifier(config, self.state, self.frame, keyframes, render, self.photometry, self.log)

    @property
    def views(self) -> list[TrainingView]:
        return self.keyframes.views

    @property
    def iterations(self) -> int:
        return self.trainer.iterations

    @property
    def median_depth(self) -> float:
        """Of the scene, in the mapper's unit."""
        return self.keyframes.median_depth

    @property
    def refinement(self) -> int:
        """Iterations of the final refinement."""
        return self.config.refinement_of(len(self.keyframes.with_image), len(self.keyframes.trained))

    @property
    def figures(self) -> dict[str, int]:
        """For the live display and the report."""
        owed = min(len(self.keyframes.owed), self.schedule.beside)  # at least
        return {
            "splats": len(self.state), "iterations": self.iterations,
            "iterations_pending": self.schedule.pending + owed,
            "image_bytes": self.keyframes.image_bytes,
        }  # fmt: skip

    def add_keyframe(self, keyframe: RGBDKeyframe, halvings: int = 0) -> int:
        """Takes in a keyframe and adds splats where the map does not show it; returns their number.

        halvings: splats as its image needs them at half the size, for half the time; from `NONE_NOW` on none, but in an
        empty map. `make_up` adds the rest.
        Without `realtime`, the pending iterations of earlier keyframes are done first, so that the result does not
        depend on how fast keyframes come. One that no camera gives is refused and counted, see `keyframe_checks`.
        """
        if self.config.realtime:
            self.log.skip("iterations_realtime", self.schedule.spare())
        else:
            while self.step():
                pass
        checked = checked_keyframe(keyframe, self.log)
        if checked is None:
            return 0
        if self.config.training.exposure:
            affine = None if checked.exposure is None else checked.exposure[None]
            self.photometry.take([checked.index], affine, checked.vignetting, self.log)
        depth = checked_depth(checked.depth, self.log)
        pose, scale = self.corrections.get(
            checked.index, (np.asarray(checked.world_from_cam, dtype=np.float64), checked.scale)
        )
        depth = depth * np.float32(scale / checked.scale)
        view = self._placed(checked, depth, pose, scale)
        if view is None:
            self.log.refuse("views", 1, "a keyframe far away from all others, or with depth so large, was refused")
            return 0
        if self.keyframes.add(view):
            self.schedule.reset()
        self.trainer.background = self.keyframes.background.color
        with self.log.time("insertion"):
            later = halvings >= NONE_NOW and len(self.state) > 0
            inserted = 0 if later else self.densifier.add(checked, view.smaller(min(halvings, NONE_NOW - 1)), depth)
        if halvings:
            self.coarse.wait(checked, later)
        view.as_taken = keyframe.photograph is None and keyframe.velocity is None
        if checked.photograph is not None and checked.velocity is not None and view.has_image:
            per_unit = scale / (checked.scale * self.frame.length)
            velocity = geometry.twist_scaled(checked.velocity, per_unit)
            view.take_photograph(checked.photograph, velocity, checked.readout_time, checked.reads_columns)
        self.schedule.add_budget(self.config.budget)
        self.log.count("inserted", inserted)
        self.log.count("views")
        self.log.count("views_without_depth", float(not (depth > 0).any()))
        return inserted

    def add_between(self, given: FrameBetween) -> bool:
        """Takes in a frame to train on, one of whose keyframes is here; False, and counted, where no camera gives it.

        No splats come from it.
        """
        keyframe = self.keyframes.of(given.keyframe)
        assert keyframe is not None
        view = between_view(given, keyframe, self.frame, self.config.max_pixels, self.state.device, self.log)
        if view is None:
            return False
        self.keyframes.add_between(view)
        self.schedule.reset()
        self.log.count("frames between keyframes")
        return True

    def step(self) -> bool:
        """One iteration that is pending, or owed to a keyframe that was corrected; False when none is due.

        What is owed takes at most a keyframe's budget beside what is pending; the rest waits for the next keyframe, or
        for the `end`.
        """
        owed = self.keyframes.owed.first(self.config.budget)
        if not self.schedule.due(owed is not None) or not self.views or len(self.state) == 0:
            self.schedule.drop()
            return False
        with self.log.time("optimization"):
            images, convergence = self.keyframes.trained, self.config.convergence
            position = self.schedule.next(len(self.keyframes.with_image), len(images), owed is not None)
            view = owed if position is None else self.chosen(images[position])
            assert view is not None
            done = convergence.skip and view.converged(convergence)
            if done and not self.schedule.chance(convergence.keep):
                self.log.skip("iterations_converged")
            else:
                self.trainer.step(view, self.median_depth)
        return True

    def end(self) -> None:
        """The stream has ended: nothing waits for what is owed, which may take as long as a short refinement."""
        self.schedule.beside = self.config.refinement_of(0)

    def make_up(self, limit: int | None = None, splats: bool = True, rate: float | None = None) -> bool:
        """A piece of what a live stream left no time for: the splats that a keyframe lacks, and when none does a
        canceled iteration, on any image. False when nothing is left.

        limit: iterations at most that are left, None: all, beside those that keyframes bring that get their splats so
        late: a thirtieth of the refinement each; splats: whether they may get them; rate: factor on all learning rates
        of an iteration that is still the stream's own, None: it is made up.
        """
        schedule, images = self.schedule, self.keyframes.trained
        schedule.spare()
        if not images or len(self.state) == 0:
            return False
        found = self.coarse.next() if splats else None
        if found is not None:
            schedule.late += limit is not None
            self._complete(*found)
            self.log.count(LATER)
            return True
        if limit is not None:
            schedule.spared = min(schedule.spared, limit + schedule.late * (self.config.refinement_of(0) // LATE))
        if not schedule.spared:
            return False
        schedule.spared -= 1
        self.log.count("iterations made up", rate is None)
        with self.log.time("optimization"):
            self.trainer.rate = 1.0 if rate is None else rate
            self.trainer.step(self.chosen(images[schedule.next_of_all(len(images))]), self.median_depth)
            self.trainer.rate = 1.0
        return True

    def begin_late(self) -> bool:
        """Adds splats as of half the image's size of the keyframe that has waited longest without any; False when none
        does."""
        found = self.coarse.without() if len(self.state) else None
        if found is not None:
            self._complete(*found, NONE_NOW - 1)
        return found is not None

    def _complete(self, keyframe: RGBDKeyframe, image: np.ndarray | None, halvings: int = 0) -> None:
        """Adds the splats that a keyframe lacks, which waited for them."""
        view = self.keyframes.of(keyframe.index)
        if view is None or not view.has_image:
            return
        with self.log.time("insertion"):
            at_once = view if image is None else view.rectified(image)
            depth = keyframe.depth * np.float32(view.scale / keyframe.scale)
            self.log.count("inserted", self.densifier.add(keyframe, at_once.smaller(halvings), depth, late=True))

    def refine(self, done: int, total: int, first_rate: float = 1.0, *, prune: bool = True) -> None:
        """Iteration `done` of `total` of the final refinement: any keyframe or frame between, rates falling from
        `first_rate`; half of them on those that are owed iterations, while any is.

        prune: at first the map is rid of splats in the air; a sixth of the way, when the newest splats have settled,
        of those that no keyframe needs; what is left makes up for them, and each iteration costs less.
        """
        if not self.views or len(self.state) == 0:
            return
        if prune and done == 0:
            self.trainer.clear_the_air(self.keyframes.with_image)
        if prune and done == total // 6:
            self.trainer.prune(self.keyframes.with_image, self.median_depth)
        with self.log.time("refinement"):
            part = done / max(total, 1)
            self.trainer.rate = max(FINAL_RATE, first_rate ** (1.0 - part) * FINAL_RATE**part)
            view = self.keyframes.owed.first(self.config.budget) if done % 2 else None
            if view is None:
                images = self.keyframes.trained
                view = self.chosen(images[self.schedule.next_of_all(len(images))])
            self.trainer.step(view, self.median_depth, refining=True)

    def correct(self, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray) -> int:
        """Takes corrected absolute poses (K, 4, 4) and cumulative scales (K,) of the keyframes `index` (K,).

        Splats move with their anchor keyframe; returns how many did. A keyframe of which what it sees moves by more
        than a pixel is trained until its loss is back, see `step`. Poses that are not finite are refused and counted.
        """
        moved: dict[int, geometry.Similarity] = {}
        for key, pose, s in zip(index.tolist(), np.asarray(world_from_cam, dtype=np.float64), scale.tolist()):
            if not is_pose(pose, s) or not self.frame.holds(pose):
                self.log.refuse("poses", 1, NO_POSE)
                continue
            self.corrections[key] = (pose, s)
            view = self.keyframes.of(key)
            if view is None:
                continue
            seen, pixel = view.footprint(), view.median_depth / view.intrinsics[0]
            similarity = view.place(pose, self.frame.local(pose), s)
            if similarity.moves(max(view.median_depth, 1e-6)):
                moved[key] = similarity
                view.begin_anew(moved=bool(similarity.shifts(seen).max() > pixel))
        for between in self.keyframes.between:
            if between.keyframe in moved:
                between.begin_anew()
        self.keyframes.corrected()
        with self.log.time("correction"):
            count = move_with_anchors(self.state, moved)
        self.log.count("corrected_keyframes", len(moved))
        return count

    def move(self, index: np.ndarray, velocity: np.ndarray, readout_time: float, reads_columns: bool = False) -> None:
        """Takes velocities (K, 6) of the camera at the keyframes `index` (K,), world units a second, NaN: as it was.

        And the time, seconds, in which their photographs were read; for those that are trained on as they were taken,
        whether that was known of them before or not, and for the frames between them, whose velocities stay. A readout
        time of 0 holds for all keyframes, as poses are those of a camera without one then.
        """
        known = dict(zip(index.tolist(), geometry.twist_scaled(velocity, 1.0 / self.frame.length)))
        self.keyframes.move(known, readout_time, reads_columns)

    def expose(self) -> int:
        """Brings keyframes and colors to what `photometry` says now; returns the number of splats that changed.

        Splats' colors go with their anchor keyframe's exposure, as their positions go with its pose.
        """
        changes: dict[int, np.ndarray] = {}
        for view in self.views:
            now, before = self.photometry.exposures.get(view.index), view.measured
            same = now is before if now is None or before is None else np.array_equal(now, before)
            if not same:
                changes[view.index] = view.expose(now)
        if changes:
            self.keyframes.background.take([view for view in self.views if view.index in changes])
            self.trainer.background = self.keyframes.background.color
        with self.log.time("correction"):
            count = recolor_with_anchors(self.state, changes)
        self.log.count("corrected_exposures", len(changes))
        return count

    def join(self, other: OnlineMapper) -> None:
        """Takes over the map of another part of the stream, of the same configuration, whose poses `correct` brought
        into this one's frame of reference.

        Splats, keyframes, moments, exposures, pose steps and pending iterations go on as they were, in this mapper's
        origin and unit; `other` is of no use afterward.
        """
        if other.frame.origin is None:
            return
        if self.frame.adopt(other.frame):
            self.keyframes.place_anew(self.frame.local, self.frame.length)
        change = self.frame.from_other(other.frame)
        larger = max(len(self.state), len(other.state))  # a known map may have more than is allowed
        with self.log.time("joining"):
            move_with_anchors(other.state, dict.fromkeys(other.state.anchors.unique().tolist(), change))
            self.state.take_over(other.state)
        other.keyframes.place_anew(self.frame.local)
        self.keyframes.take_over(other.keyframes, change.scale)
        self.trainer.background = self.keyframes.background.color
        self.trainer.bound(self.keyframes.with_image, self.median_depth, larger)
        self.schedule.take_over(other.schedule)
        self.coarse.take_over(other.coarse)
        self.trainer.iterations += other.trainer.iterations

    def render(self, view: TrainingView, size: tuple[int, int] | None = None) -> Render:
        """The map from a keyframe's pose, without gradients. size: height, width; None: the training image's."""
        return self.trainer.render(view, self.median_depth, size)

    def self_check(self, max_keyframes: int = 20) -> SelfCheck | None:
        """How well the map shows its keyframes, some of them, spread over the stream; None without any."""
        images = self.keyframes.with_image
        views = images[:: -(-len(images) // max_keyframes) or 1]
        return check(self._beside(view) for view in views)

    def _beside(self, view: TrainingView) -> Shown:
        """Render and image (H, W, 3) of a keyframe, and which pixels count."""
        color, valid = self.render(view).color.clamp(0.0, 1.0), view.valid
        return color.cpu().numpy(), view.target.cpu().numpy(), None if valid is None else valid.cpu().numpy()

    def snapshot(self) -> Snapshot:
        """The map in world units, relative to its origin."""
        training = self.config.training
        return snapshot(
            self.state, self.views, self.frame, training.kernel, self.iterations, self.photometry.vignetting,
            training.antialiased, self.trainer.background,
        )  # fmt: skip

    def chosen(self, view: TrainingView) -> TrainingView:
        """To train on now: a frame between keyframes where its keyframe stands."""
        if isinstance(view, BetweenView):
            keyframe = self.keyframes.of(view.keyframe)
            assert keyframe is not None
            view.follow(keyframe, self.frame)
        return view

    def _placed(self, keyframe: RGBDKeyframe, depth: np.ndarray, pose: np.ndarray, scale: float) -> TrainingView | None:
        """To train on, in the mapper's frame, which the first ones begin; None where it is too far away from it."""
        median = median_of_known(depth)
        if median == 0 and keyframe.unfiltered is not None:  # the filters kept nothing: doubtful depth gives the scale
            median = median_of_known(keyframe.unfiltered) * scale / keyframe.scale
        if not self.frame.holds(pose, median):
            return None
        if self.frame.begin(pose, median):
            self.keyframes.place_anew(self.frame.local, self.frame.length)
        view = training_view(keyframe, self.frame.local(pose), self.config.max_pixels, self.state.device)
        view.world_from_cam, view.scale, view.median_depth = pose, scale, median / self.frame.length
        view.surface, view.fixed = surface_of(depth / np.float32(self.frame.length)), not self.views
        view.expose(self.photometry.exposures.get(view.index))
        if view.valid is not None:
            left_out = int((~view.valid).sum())
            if keyframe.mask is not None:
                self.log.skip("pixels_masked", left_out)
            else:
                self.log.refuse("pixels", left_out, "pixels that are not finite were left out of the training")
        return view
