"""A tracker whose poses are given: it chooses keyframes and triangulates their depths from matches."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.bundle_adjustment import Solver, reproject
from mvsgs_core.tracking.flow import Matches, make_flow
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage, tracking_size
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.matcher import Matcher


@dataclass(frozen=True)
class PosedConfig:
    area: int = 320 * 240  # pixels of the tracker's image
    flow: str = "lucas_kanade"
    readout: float = 0.0  # seconds of a rolling shutter, 0 for a global one: it is not estimated here
    threads: int = 1
    front_end: FrontEndConfig = field(default_factory=lambda: FrontEndConfig(still_flow=0.0))
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)


class PosedTracker:
    """Keyframes come one keyframe late: their depths are triangulated with one that follows."""

    def __init__(self, config: PosedConfig | None = None) -> None:
        self.config = config or PosedConfig()
        self.stats = Stats()
        self.graph: KeyframeGraph | None = None
        self.pending: list[int] = []  # keyframes not given out yet

    def add(
        self, index: int, timestamp: float, image: np.ndarray, intrinsics: np.ndarray, world_from_cam: np.ndarray
    ) -> list[int]:
        """The next frame with its pose (4, 4). Returns the keyframes, by index, that are complete now."""
        if self.graph is None:
            self._set_up(image.shape[0], image.shape[1], intrinsics)
            assert self.graph is not None
        frame = TrackingImage.of(index, timestamp, image, self.size, self.flow.needs_color)
        self.stats.count("frames")
        pose = geometry.inverse(world_from_cam)
        if self.front_end.reference is None:
            return self._first(frame, pose)
        with self.stats.time("front end"):
            step = self.front_end.follow(frame, started=False)
        if not self.front_end.is_lost(step):
            if not self.front_end.wants_keyframe(step, self.config.front_end.keyframe_flow):
                return []
            matches = {self.front_end.reference.index: step.matches}
        else:
            matches = {}
        if len(self.graph.keyframes) == 1:
            self._first_depth(pose, matches)
        with self.stats.time("triangulation"):
            self.local_map.insert(frame, pose, 0, matches)
            members = self.local_map.members(0)
            recent = set(members[-self.config.local_map.window :])
            around = {n for i in recent for n in self.graph.neighbors(i)}
            solver = Solver(steps=self.config.local_map.steps, threads=self.config.threads)
            solution = self.graph.optimize(recent | around, set(), recent, solver)
        if solution.failure:
            self.stats.warn(f"triangulation failed: {solution.failure}")
        for old in members[: -self.config.local_map.window]:
            self.graph.keyframes[old].image.release()
        self.front_end.refer_to(frame)
        self.stats.count("keyframes")
        complete, self.pending = self.pending, [index]
        return complete

    def finish(self) -> list[int]:
        """The stream has ended: the last keyframe."""
        complete, self.pending = self.pending, []
        return complete

    def keyframe(self, index: int) -> Keyframe:
        assert self.graph is not None
        return self.graph.keyframes[index]

    def _set_up(self, height: int, width: int, intrinsics: np.ndarray) -> None:
        self.size = tracking_size(height, width, self.config.area)
        self.graph = KeyframeGraph(scale_intrinsics(intrinsics, (height, width), self.size))
        self.graph.readout = self.config.readout
        self.flow = make_flow(self.config.flow)
        matcher = Matcher(self.flow)
        self.front_end = FrontEnd(self.graph, matcher, self.config.front_end, self.config.threads)
        self.local_map = LocalMap(self.graph, matcher, self.config.local_map, self.config.threads)

    def _first(self, frame: TrackingImage, pose: np.ndarray) -> list[int]:
        assert self.graph is not None
        ones = np.ones(len(frame.cells.points))
        self.graph.add(Keyframe(frame, pose, ones, 0.0 * ones, 0))
        self.front_end.refer_to(frame)
        self.stats.count("keyframes")
        self.pending = [frame.index]
        return []

    def _first_depth(self, pose: np.ndarray, matches: dict[int, Matches]) -> None:
        """The unit of the given poses is unknown: the inverse depth that explains the first flow best is tried out."""
        assert self.graph is not None
        ((index, keyframe),) = self.graph.keyframes.items()
        found = self.front_end.step.matches if self.front_end.step else None
        if not matches or found is None:
            return
        baseline = float(np.linalg.norm((pose @ self.graph.world_from_cam(index))[:3, 3]))
        if baseline <= 0.0:
            return
        best = (np.inf, 1.0)
        for ratio in np.geomspace(1e-3, 3.0, 40):
            depths = np.full_like(keyframe.inverse_depth, ratio / baseline)
            pixels, _ = reproject(
                np.stack([keyframe.cam_from_world, pose]),
                depths[None],
                keyframe.points.T[None].astype(np.float64),
                self.graph.intrinsics,
                np.array([0]),
                np.array([1]),
            )
            error = np.linalg.norm(pixels[0].T - found.target, axis=1)[found.alive]
            best = min(best, (float(np.median(error)), float(ratio / baseline)))
        keyframe.inverse_depth = np.full_like(keyframe.inverse_depth, best[1])


__all__ = ["PosedConfig", "PosedTracker"]
