"""The keyframe graph: what the tracker knows of the scene. Keyframes with inverse depths, edges of matches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.edges import Edge, Edges
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, Solution, Solver, adjust, reproject
from mvsgs_core.tracking.estimation.static_points import static_weights
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.keyframes import Keyframe, KeyframeTable
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.steps import Steps, whole

# What resists a change of an inverse depth d in each step, as a fraction of 1 / d². It is no prior: drawn to the depths
# that keyframes were given, whole maps bend (rotation against depth), by 5 % on the synthetic room.
DAMPING = 0.5

Solved: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # pose, inverse depth, information, static


class KeyframeGraph:
    """Keyframes in the order of their indices, and directed edges by their positions in that order."""

    def __init__(self, intrinsics: np.ndarray, device: str = "cpu") -> None:
        self.intrinsics = np.asarray(intrinsics, dtype=np.float64)  # (4,) at the tracker's size
        self.device = device  # of the bundle adjustments of several keyframes, see Solver
        self.readout_time = 0.0  # seconds that the camera needs for an image, from the first row to the last
        self.reads_columns = False  # the same from the first column to the last
        self.vignetting = np.zeros(3)  # of log V = l1 r² + l2 r⁴ + l3 r⁶, as far as it is known
        self.weighing = False  # points by how still they stand: a calibration that may be wrong would move them all
        self.keyframes = KeyframeTable()  # by frame index
        self.edges = Edges()  # by frame indices

    def add(self, keyframe: Keyframe) -> None:
        self.keyframes[keyframe.index] = keyframe

    def remove(self, index: int) -> None:
        del self.keyframes[index]
        for pair in self.edges.of([index]):
            del self.edges[pair]

    def connect(self, source: int, to: int, matches: Matches, min_fraction: float) -> bool:
        """Adds an edge; False, and no edge, where too few of the textured points were found."""
        textured = self.keyframes[source].image.cells.textured
        fraction = float(matches.alive[textured].sum() / max(1, textured.sum()))
        if fraction < min_fraction or matches.alive.sum() < 30:
            return False
        target = np.nan_to_num(matches.target.T)
        velocity = np.zeros(target.shape) if matches.velocity is None else matches.velocity.T
        self.edges[source, to] = Edge(target, matches.weight, velocity, fraction)
        return True

    def solved(self, indices: Iterable[int]) -> dict[int, Solved]:
        """What a bundle adjustment changes of these keyframes, as it is now."""
        frames = {index: self.keyframes[index] for index in indices}
        return {index: (k.cam_from_world, k.inverse_depth, k.information, k.static) for index, k in frames.items()}

    def put_back(self, solved: dict[int, Solved]) -> None:
        """Keyframes as they were."""
        for index, (pose, inverse_depth, information, static) in solved.items():
            keyframe = self.keyframes[index]
            keyframe.cam_from_world, keyframe.inverse_depth = pose, inverse_depth
            keyframe.information, keyframe.static = information, static

    def neighbors(self, index: int) -> set[int]:
        return self.edges.reached([index]) - {index}

    def but_first(self, indices: Iterable[int]) -> set[int]:
        """These without the first of each segment, which holds its place where the others' poses are free."""
        order = sorted(indices)
        first: dict[int, int] = {}
        for index in order:
            first.setdefault(self.keyframes[index].segment, index)
        return set(order).difference(first.values())

    def predict(self, source: int, to: int) -> tuple[np.ndarray, np.ndarray]:
        """Where the points of `source` should be seen in `to`: (M, 2), NaN behind it; and inside the image (M,)."""
        at, inside = self.predict_pose(source, self.keyframes[to].cam_from_world)
        return self.as_read(at, self.keyframes[to].image), inside

    def predict_pose(
        self, source: int, cam_from_world: np.ndarray, at_infinity: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same for a camera (4, 4) without a rolling shutter; at_infinity: were the points infinitely far."""
        keyframe = self.keyframes[source]
        pixels, z = reproject(
            np.stack([keyframe.cam_from_world, cam_from_world]),
            keyframe.inverse_depth[None] * (0.0 if at_infinity else 1.0),
            self.pixels(source)[None],
            self.intrinsics,
            np.array([0]),
            np.array([1]),
        )
        at = np.where(z[0] > 0.05, pixels[0], np.nan).T
        height, width = keyframe.image.size
        with np.errstate(invalid="ignore"):
            inside = np.all((at >= 0) & (at <= [width - 1, height - 1]), axis=1)
        return at, inside

    def as_read(self, points: np.ndarray, image: TrackingImage) -> np.ndarray:
        """Where the rolling shutter sees what a global one would see at points (N, 2) of an image."""
        return points + self._moved(points, image.velocity_at(points), image.size)

    def rectified(self, points: np.ndarray, velocity: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Where a global shutter would have seen what the rolling one saw at points (N, 2), which move at `velocity`
        (N, 2) pixels a second, of an image of `size` (height, width)."""
        if not self.readout_time:
            return points
        return points - self._moved(points, velocity, size)

    def _moved(self, points: np.ndarray, velocity: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        axis = 0 if self.reads_columns else 1
        return np.asarray(self.readout_time * (velocity * (points[:, axis : axis + 1] / size[1 - axis] - 0.5)))

    def pixels(self, index: int) -> np.ndarray:
        """Where a global shutter would have seen the points of a keyframe: (2, M) float64."""
        image = self.keyframes[index].image
        return self.rectified(image.cells.points, image.cell_velocity, image.size).T.astype(np.float64)

    def problem(self, indices: Iterable[int], free_poses: set[int], free_depths: set[int]) -> Graph:
        """The bundle adjustment of these keyframes and every edge among them that has something free at an end."""
        order = sorted(indices)
        number = {index: n for n, index in enumerate(order)}
        pairs = [
            (a, b)
            for a, b in self.edges.of(free_poses | free_depths)
            if a in number and b in number and (a in free_poses or b in free_poses or a in free_depths)
        ]
        frames = [self.keyframes[index] for index in order]
        cells = len(frames[0].inverse_depth)
        information = np.zeros((len(pairs), 3, cells))
        target = np.zeros((len(pairs), 2, cells))
        for n, (a, b) in enumerate(pairs):
            edge = self.edges[a, b]
            found, (at, velocity, weight) = edge.found, edge.of_found
            target[n][:, found] = self.rectified(at.T, velocity.T, frames[0].image.size).T
            information[n][:, found] = self.keyframes[a].image.cells.information[found].T * weight
        inverse_depth = np.stack([k.inverse_depth for k in frames])
        return Graph(
            cam_from_world=np.stack([k.cam_from_world for k in frames]),
            inverse_depth=inverse_depth,
            pixels=np.stack([self.pixels(index) for index in order]),
            intrinsics=self.intrinsics,
            source=np.array([number[a] for a, _ in pairs], np.int32),
            to=np.array([number[b] for _, b in pairs], np.int32),
            target=target,
            information=information,
            free_pose=np.array([index in free_poses for index in order]),
            free_depth=np.array([index in free_depths for index in order]),
            damping=DAMPING / inverse_depth**2,
        )

    def optimize(
        self,
        indices: Iterable[int],
        free_poses: set[int],
        free_depths: set[int],
        solver: Solver,
        free_focal: bool = False,
    ) -> Solution:
        """Bundle adjustment of a part of the graph, written back unless it failed."""
        return whole(self.optimizing(indices, free_poses, free_depths, solver, free_focal))

    def optimizing(
        self,
        indices: Iterable[int],
        free_poses: set[int],
        free_depths: set[int],
        solver: Solver,
        free_focal: bool = False,
    ) -> Steps[Solution]:
        """`optimize`: the problem is set up in one step and solved in the other, and then the graph changes."""
        order = sorted(indices)
        problem = self.problem(order, free_poses, free_depths)
        problem.free_focal = free_focal
        if self.weighing:
            problem.static = np.stack([self.keyframes[index].static for index in order])
        yield
        solution = adjust(problem, replace(solver.reaching(problem), device=self.device))
        if not solution.failure:
            self.intrinsics = self.intrinsics * [solution.focal_factor, solution.focal_factor, 1.0, 1.0]
            for n, index in enumerate(order):
                keyframe = self.keyframes[index]  # given copies: a view of its row would keep the whole solution
                if index in free_poses:
                    keyframe.cam_from_world = solution.cam_from_world[n].copy()
                if index in free_depths:
                    keyframe.inverse_depth = solution.inverse_depth[n].copy()
                    keyframe.information = solution.information[n].copy()
            self._weigh(problem, solution, order)
        return solution

    def _weigh(self, problem: Graph, solution: Solution, order: list[int]) -> None:
        """The weights of the points whose depths are new."""
        if not self.weighing:
            return
        adjusted = replace(
            problem,
            cam_from_world=solution.cam_from_world,
            inverse_depth=solution.inverse_depth,
            intrinsics=self.intrinsics,
        )
        weights = static_weights(adjusted)
        for n in np.flatnonzero(problem.free_depth):
            keyframe = self.keyframes[order[n]]
            keyframe.static = np.where(np.isnan(weights[n]), keyframe.static, weights[n])

    def rescale(self, indices: Iterable[int], factor: float) -> None:
        """Multiplies every length of these keyframes, as seen from the world's origin."""
        for index in indices:
            keyframe = self.keyframes[index]
            keyframe.cam_from_world = geometry.scaled(keyframe.cam_from_world, factor)
            keyframe.inverse_depth = keyframe.inverse_depth / factor
            keyframe.information = keyframe.information * factor**2

    def world_from_cam(self, index: int) -> np.ndarray:
        return geometry.inverse(self.keyframes[index].cam_from_world)


__all__ = ["Edge", "Keyframe", "KeyframeGraph", "Solved"]
