"""The frontend: solves the start, then the window of each new keyframe (DROID-SLAM, section 3.3)."""

from __future__ import annotations

import numpy as np

from mvsgs_core.droid.config import Constants
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.proximity import by_proximity, neighborhood
from mvsgs_core.droid.video import Video
from mvsgs_core.stats import Stats

_START_UPDATES = 8  # with edges to neighbors, and again with edges by proximity
_START_REACH, _START_RADIUS, _START_NMS, _START_BETA = 3, 2, 2, 0.25
_KEPT_FROM_START = 4  # keyframes before the end of the start whose edges stay active
_RECENT = 5  # newest keyframes that get new edges
MIN_KEYFRAMES = 4  # of a forced start


class Frontend:
    def __init__(self, video: Video, graph: FactorGraph, constants: Constants, stats: Stats) -> None:
        self.video, self.graph, self.constants, self.stats = video, graph, constants, stats
        self.started = False
        self._mean_over = 1  # keyframes whose mean inverse depth a new one begins with

    @property
    def settled(self) -> int:
        """Keyframes that can no longer be dropped: all but the newest."""
        return max(0, len(self.video) - 1) if self.started else 0

    def start_values(self) -> tuple[np.ndarray, float]:
        """Pose and inverse depth of a new frame."""
        if not self.started:
            return np.eye(4), 1.0
        newest = self.video.frames[-self._mean_over :]
        return newest[-1].cam_from_world.copy(), float(np.mean([frame.inverse_depth.mean() for frame in newest]))

    def advance(self) -> bool:
        """A frame joined the video. Returns False if that made the keyframe before it superfluous."""
        if not self.started:
            if len(self.video) == self.constants.warmup:
                self._start()
            return True
        return self._go_on()

    def force_start(self) -> bool:
        """The stream has ended before the warm-up did. Returns False if there are too few keyframes."""
        if not self.started and len(self.video) >= MIN_KEYFRAMES:
            self._start()
        return self.started

    def _start(self) -> None:
        count = len(self.video)
        with self.stats.time("start"):
            self.graph.add(neighborhood(count, _START_REACH))
            self._update(_START_UPDATES, first_free=1)
            self.graph.add(self._near(0, 0, _START_RADIUS, _START_NMS, _START_BETA))
            self._update(_START_UPDATES, first_free=1)
        self.graph.retire_before(count - _KEPT_FROM_START)
        self.started = True
        self._mean_over = 4

    def _go_on(self) -> bool:
        constants, video, graph = self.constants, self.video, self.graph
        count = len(video)
        back = max(count - constants.frontend_window, 0)
        graph.retire_older(constants.max_age)
        graph.forget_before(back - 2 * _RECENT)
        with self.stats.time("edges"):
            first, radius, nms = max(count - _RECENT, 0), constants.frontend_radius, constants.frontend_nms
            near = self._near(first, back, radius, nms, constants.beta)
            self.stats.count("edges", graph.add(near, make_room=True))
        self._mean_over = 1
        with self.stats.time("local updates"):
            self._update(constants.first_updates)
            moved = video.distances(np.array([count - 3]), np.array([count - 2]), constants.beta)[0]
            if moved < constants.keyframe_threshold:
                graph.remove_keyframe(count - 2)
                self.stats.skip("keyframes too near the one before")
                return False
            self._update(constants.further_updates)
        return True

    def _near(self, first_source: int, first_to: int, radius: int, nms: int, beta: float) -> list[tuple[int, int]]:
        return by_proximity(
            self.video,
            first_source=first_source,
            first_to=first_to,
            existing=[edge.pair for edge in (*self.graph.active, *self.graph.inactive)],
            radius=radius,
            nms=nms,
            threshold=self.constants.frontend_threshold,
            beta=beta,
            limit=self.constants.max_factors,
        )

    def _update(self, times: int, first_free: int | None = None) -> None:
        for _ in range(times):
            self.stats.count("edges revised", len(self.graph.active))
            solution = self.graph.update(first_free, use_inactive=True)
            if solution.failure:
                self.stats.count("failed bundle adjustments")
                self.stats.warn(f"local bundle adjustment failed: {solution.failure}")


__all__ = ["Frontend"]
