"""Poses of the first keyframes from two of them: an essential matrix, its points, and the others' poses from those.

What most matches agree on decides, so that what moves has no part in it, where it is the lesser part of the image.
"""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import matrix
from mvsgs_core.tracking.edges import Edge
from mvsgs_core.tracking.estimation.perspective import pose_of_points
from mvsgs_core.tracking.graph import KeyframeGraph

AGREES = 1.0  # pixels from where a pose puts a point
FEW = 20  # points that a pose needs


def widest_pairs(graph: KeyframeGraph, order: list[int], count: int) -> list[tuple[int, int]]:
    """The pairs of keyframes with the widest flow over the most matches, the best first."""
    rated = []
    for a, b in graph.edges:
        if a not in order or b not in order:
            continue
        edge = graph.edges[a, b]
        moved = np.linalg.norm(edge.target.T - graph.keyframes[a].points, axis=1)[edge.found]
        rated.append((float(np.median(moved)) * edge.fraction, a, b))
    return [(a, b) for _, a, b in sorted(rated, reverse=True)[:count]]


def two_view_poses(
    graph: KeyframeGraph, order: list[int], pair: tuple[int, int], epipolar: float = 1.0
) -> np.ndarray | None:
    """Poses (K, 4, 4) of keyframes `order`, the first at the origin, from a pair of them; None where it gives none.

    epipolar: pixels from an epipolar line within which a match agrees. A keyframe that sees too little of the pair's
    points is put where the time puts it.
    """
    a, b = pair
    edge, camera = graph.edges[a, b], matrix(graph.intrinsics)
    seen = np.flatnonzero(edge.found)
    here, there = graph.keyframes[a].points[seen].astype(np.float64), edge.target.T[seen].astype(np.float64)
    cv2.setRNGSeed(0)
    try:
        essential, mask = cv2.findEssentialMat(here, there, camera, cv2.USAC_MAGSAC, 0.999, epipolar)
        if essential is None or essential.shape != (3, 3):
            return None
        _, rotation, translation, inside, points = cv2.recoverPose(
            essential, here, there, camera, distanceThresh=100.0, mask=mask
        )
    except cv2.error:  # OpenCV throws where it finds no model at all
        return None
    relative = geometry.rigid(rotation, translation.ravel())
    known = inside.ravel() > 0
    points = (points[:3, known] / points[3, known]).T
    seen = seen[known]
    unit = float(np.median(points[:, 2])) if len(points) else 10.0
    twist = geometry.se3_log(relative)
    poses = []
    for index in order:
        pose = None
        if index == a:
            pose = np.eye(4)
        elif index == b:
            pose = relative
        elif (a, index) in graph.edges:
            pose = _pose(points, seen, graph.edges[a, index], camera)
        poses.append(geometry.se3_exp((index - a) / (b - a) * twist) if pose is None else pose)
    stacked = np.stack(poses)
    stacked[:, :3, 3] /= unit
    return np.asarray(stacked @ geometry.inverse(stacked[0]))


def _pose(points: np.ndarray, cells: np.ndarray, edge: Edge, camera: np.ndarray) -> np.ndarray | None:
    """(4, 4) of the image at an edge's end, from points (N, 3) of cells (N,) at its source."""
    use = edge.found[cells]
    if use.sum() < FEW:
        return None
    return pose_of_points(points[use], edge.target.T[cells[use]].astype(np.float64), camera, AGREES)


__all__ = ["two_view_poses", "widest_pairs"]
