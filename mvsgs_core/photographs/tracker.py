"""Photographs as a tracker: nothing is known before the last one; then all leave as keyframes, as the map saw them.

Held-out photographs (held_out.py) get poses from the finished map and add nothing to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.held_out import is_held_out
from mvsgs_core.photographs.config import PhotographsConfig
from mvsgs_core.photographs.light import Light, Look
from mvsgs_core.photographs.ordering import chain, covisibility
from mvsgs_core.photographs.reconstruction import MIN_PHOTOGRAPHS
from mvsgs_core.photographs.sparse_map import Model
from mvsgs_core.photographs.structure import Photographs
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.image import CELL, tracking_size
from mvsgs_core.tracking.keyframe_choice import HELD_OUT
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.trajectory import TrackingState, Trajectory

FAR_OFF = 1.25  # or its inverse: the focal length that was found, over one that was said to be known
RELATIVE_SIGMA = 0.1  # error of an inverse depth, for one pixel of matching, at which its confidence is a half


@dataclass(frozen=True)
class PhotographKeyframe:
    """One photograph with what the map knows of it. The unit is the median depth of its part's first keyframe."""

    world_from_cam: np.ndarray  # (4, 4)
    inverse_depth: np.ndarray  # (h, w) float32, 0 where no point was seen
    weight: np.ndarray  # (h, w) float32 confidence, 0 to 1
    segment: int


class PhotographTracker:
    """What `nodes.tracking` asks of a tracker."""

    def __init__(self, config: PhotographsConfig) -> None:
        self.config = config
        self.stats = Stats()
        if config.because:
            self.stats.warn(config.because)
        self.nothing = ""
        self.phase = Phase.INITIALIZING
        self.photographs = Photographs(config, self.stats)
        self.light = Light(self.stats)
        self._frames: list[tuple[int, float]] = []  # index and timestamp
        self._sizes: list[tuple[int, int]] = []
        self._guessed = False  # the focal length of a photograph was
        self._held_out = np.zeros(0, bool)  # (P,) once solved
        self._models: list[Model] = []
        self._units: list[float] = []  # of each model
        self._keyframes: dict[int, tuple[int, int]] = {}  # index -> model, photograph
        self.pending: set[int] = set()

    def add(
        self, index: int, timestamp: float, image: np.ndarray, intrinsics: np.ndarray, guessed: bool, exposure: float,
        place: np.ndarray | None = None, mask: np.ndarray | None = None,
    ) -> Update:  # fmt: skip
        """The next photograph. guessed: its focal length is not known at all. exposure, place, mask: as of
        `msgs.Frame`."""
        self.stats.count("frames")
        self.photographs.add(image, intrinsics, guessed, place, mask)
        self.light.looks.append(Look.of(image, intrinsics, exposure, self.config.area, mask))
        self._frames.append((index, timestamp))
        self._sizes.append((image.shape[0], image.shape[1]))
        self._guessed |= guessed
        self.pending.add(index)
        return Update(TrackingState.NOT_INITIALIZED)

    def finish(self) -> Iterator[Update]:
        """All keyframes, one at a time, neighbors after each other; the parts of the map one after another."""
        self._solve()
        for number, model in enumerate(self._models):
            members = np.flatnonzero(model.registered & ~self._held_out).tolist()
            order = chain(covisibility(model.photograph, model.point, len(self._frames)), members)
            self._units.append(self._unit(model, order))
            for n in order:
                index = self._frames[n][0]
                self._keyframes[index] = (number, n)
                self.stats.count("keyframes")
                yield Update(TrackingState.TRACKED, keyframes=(index,))
                self.pending.discard(index)
        self.pending.clear()

    @property
    def lens(self) -> tuple[float, float, float]:
        """Factor on the focal lengths, and k1, k2 of the photographs as they came: of the largest part of the map."""
        return self._lens_of(0) if self._models else (1.0, 0.0, 0.0)

    def keyframe_lens(self, index: int) -> tuple[float, float, float]:
        """As `lens`, of the part that a keyframe is in."""
        return self._lens_of(self._keyframes[index][0])

    def _lens_of(self, part: int) -> tuple[float, float, float]:
        lens = self._models[part].lens
        return lens.factor, lens.k1, lens.k2

    def keyframe(self, index: int, intrinsics: np.ndarray, size: tuple[int, int]) -> PhotographKeyframe:
        """A keyframe as a pinhole camera with `intrinsics` (4,) and images of `size` (height, width) would see it."""
        number, n = self._keyframes[index]
        model, unit = self._models[number], self._units[number]
        pose = model.cam_from_world[n].copy()
        pose[:3, 3] /= unit
        inverse_depth, weight = self._points_seen(model, n, intrinsics, size)
        return PhotographKeyframe(geometry.inverse(pose), inverse_depth * np.float32(unit), weight, number)

    def trajectory(self) -> Trajectory:
        """All photographs, in the order in which they came."""
        count = len(self._frames)
        poses, segment = np.full((count, 4, 4), np.nan), np.full(count, -1, np.int32)
        for number, (model, unit) in enumerate(zip(self._models, self._units)):
            found = model.registered
            cams = model.cam_from_world[found].copy()
            cams[:, :3, 3] /= unit
            poses[found], segment[found] = geometry.inverse(cams), number
        index = np.array([index for index, _ in self._frames], np.int64)
        return Trajectory(
            index=index,
            timestamp=np.array([timestamp for _, timestamp in self._frames], np.float64),
            world_from_cam=poses,
            keyframe=np.isin(index, list(self._keyframes)),
            state=np.where(segment >= 0, TrackingState.TRACKED, TrackingState.LOST).astype(np.uint8),
            segment=segment,
            exposure=self.light.exposures(),
            vignetting=self.light.vignetting,
        )

    def exposure(self, index: int) -> np.ndarray | None:
        """(3, 4) float32 color affine of a keyframe, see `msgs`; None where exposures do not vary."""
        return self.light.exposure(self._keyframes[index][1])

    def _solve(self) -> None:
        count = len(self._frames)
        self._held_out = np.array([is_held_out(index) for index, _ in self._frames], bool)
        mapped = ~self._held_out
        self._models = self.photographs.solve(mapped)
        posed = np.zeros(count, bool)
        for model in self._models:
            posed |= model.registered
        with self.stats.time("photometry"):
            self.light.solve(self.photographs.features, self.photographs.pairs, mapped, posed)
        missing = count - sum(int(model.registered.sum()) for model in self._models)
        if missing and len(self._models):
            self.stats.warn(f"photographs without a pose, too little of them matches the others: {missing} of {count}")
        if len(self._models) > 1:
            self.stats.warn(f"the photographs fall into {len(self._models)} parts that share too little")
        if count < MIN_PHOTOGRAPHS:
            self.nothing = f"no photograph has a pose, of {count}: {MIN_PHOTOGRAPHS} or more of one scene are needed"
        elif not self._models:
            pairs = self.photographs.stats.counts.get("pairs of photographs that agree with one geometry", 0)
            self.nothing = (
                f"no photograph has a pose, of {count}: {pairs:.0f} pairs of them agree with one geometry, and of none "
                f"a map of {MIN_PHOTOGRAPHS} photographs grows. Take them from different places, each overlapping "
                "others by half"
            )
        else:
            self._warn_of_focal()
            self.phase = Phase.TRACKING
            residuals = np.concatenate([model.residual for model in self._models])
            self.stats.values["reprojection error, median"] = f"{np.median(residuals):.2f} pixels"
        self.stats.count(HELD_OUT, 0)

    def _warn_of_focal(self) -> None:
        factor = self._models[0].lens.factor
        if not self._guessed and not 1.0 / FAR_OFF < factor < FAR_OFF:
            self.stats.warn(
                f"by the photographs, the focal length is {factor:.2f} times the one that is said to be known; if that "
                "is wrong, and the map bent by it, begin with a better one: dataset.intrinsics=[fx,fy,cx,cy]"
            )

    def _unit(self, model: Model, order: list[int]) -> float:
        """The median depth of the first keyframe, as everywhere in the tracker."""
        for n in order:
            depths = self._depths(model, n)[1]
            if len(depths):
                return float(np.median(depths))
        return 1.0

    def _depths(self, model: Model, n: int) -> tuple[np.ndarray, np.ndarray]:
        """The points that a photograph sees, in its camera (K, 3), and their depths (K,)."""
        mine = model.photograph == n
        pose = model.cam_from_world[n]
        seen = model.points[model.point[mine]] @ pose[:3, :3].T + pose[:3, 3]
        return seen, seen[:, 2]

    def _points_seen(
        self, model: Model, n: int, intrinsics: np.ndarray, size: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverse depth and confidence of a photograph's points on the tracker's grid, the surest of each cell."""
        small = tracking_size(*size, self.config.area)
        fx, fy, cx, cy = scale_intrinsics(intrinsics, size, small)
        seen, depth = self._depths(model, n)
        rows, columns = small[0] // CELL, small[1] // CELL
        inverse_depth, weight = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
        # one pixel of matching changes the inverse depth by 1 / (f * angle) of it
        sigma = 1.0 / (0.5 * (fx + fy) * np.maximum(self._angles(model, n), 1e-6))
        confidence = 1.0 / (1.0 + (sigma / RELATIVE_SIGMA) ** 2)
        u = np.floor((fx * seen[:, 0] / depth + cx + 0.5) / CELL).astype(int)
        v = np.floor((fy * seen[:, 1] / depth + cy + 0.5) / CELL).astype(int)
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        order = np.flatnonzero(inside)[np.argsort(confidence[inside], kind="stable")]  # the surest is written last
        inverse_depth[v[order], u[order]] = 1.0 / depth[order]
        weight[v[order], u[order]] = confidence[order]
        return inverse_depth, weight

    def _angles(self, model: Model, n: int) -> np.ndarray:
        """(K,) widest angle between the ray of photograph n to each of its points and another's, radians."""
        points = np.unique(model.point[model.photograph == n])
        at = np.full(len(model.points), -1)
        at[points] = np.arange(len(points))
        use = np.flatnonzero((at[model.point] >= 0) & (model.photograph != n))
        centers = geometry.inverse(model.cam_from_world[model.registered])[:, :3, 3]
        place = np.cumsum(model.registered) - 1
        rays = model.points[model.point[use]] - centers[place[model.photograph[use]]]
        own = model.points[points] - centers[place[n]]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        angle = np.arccos(np.clip(np.sum(rays * own[at[model.point[use]]], axis=1), -1.0, 1.0))
        widest = np.zeros(len(points))
        np.maximum.at(widest, at[model.point[use]], angle)
        return np.asarray(widest[at[model.point[model.photograph == n]]])


__all__ = ["PhotographKeyframe", "PhotographTracker"]
