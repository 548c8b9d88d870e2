"""Geometric verification of a place: an old keyframe in an image, with no idea of the pose.

Features, then Lucas-Kanade, then a pose that must meet the criteria.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvsgs_core.camera import matrix
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.estimation.perspective import pose_of_points
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.features import match_features
from mvsgs_core.tracking.matching.flow import Matches, propagate
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.localization import Localization, localize
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.steps import Steps, whole

ROWS = 256  # queries whose distances to all points are in memory at once


@dataclass(frozen=True)
class PlaceMatch:
    """Keyframe `index` sees what an image sees."""

    index: int
    matches: Matches  # of its points
    localization: Localization  # of the image, in the keyframe's map


def verify_place(
    graph: KeyframeGraph, matcher: Matcher, index: int, image: TrackingImage, criteria: PoseCriteria
) -> PlaceMatch | None:
    """None where the keyframe's points are not found or no pose explains them."""
    return whole(verifying_place(graph, matcher, index, image, criteria))


def verifying_place(
    graph: KeyframeGraph, matcher: Matcher, index: int, image: TrackingImage, criteria: PoseCriteria
) -> Steps[PlaceMatch | None]:
    """`verify_place`: features, matches and pose, a step each."""
    keyframe = graph.keyframes[index]
    from_keyframe, in_image = match_features(keyframe.image, image, threshold=1.5)
    if len(from_keyframe) < 15:
        return None
    yield
    guess = propagate(from_keyframe, in_image - from_keyframe, keyframe.points, 3, 0.15 * image.longer_side)
    matches, fraction = matcher.match(keyframe.image, image, guess, 0.0)
    known = matches.alive & keyframe.triangulated
    if fraction < criteria.min_fraction or known.sum() < criteria.min_matches:
        return None
    yield
    u, v = keyframe.points[known].T.astype(np.float64)
    fx, fy, cx, cy = graph.intrinsics
    depth = 1.0 / keyframe.inverse_depth[known]
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=1)
    relative = pose_of_points(points, matches.target[known], matrix(graph.intrinsics), 3.0)
    if relative is None:
        return None
    localization = localize(graph, index, matches, relative @ keyframe.cam_from_world, Solver(steps=10))
    if not criteria.accept(graph, index, matches, localization):
        return None
    return PlaceMatch(index, matches, localization)


def relative_scale(graph: KeyframeGraph, place: PlaceMatch, index: int) -> float | None:
    """Unit of keyframe `index`'s own depths over the unit of the place's keyframe; None where too few compare."""
    here, seen = graph.keyframes[index], graph.keyframes[place.index]
    usable = place.matches.alive & seen.triangulated
    own = np.flatnonzero(here.triangulated)
    if usable.sum() < 20 or len(own) < 20:
        return None
    relative = place.localization.cam_from_world @ graph.world_from_cam(place.index)
    fx, fy, cx, cy = graph.intrinsics
    u, v = seen.points[usable].T.astype(np.float64)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
    z = relative[2, :3] @ rays / seen.inverse_depth[usable] + relative[2, 3]
    at = place.matches.target[usable]
    nearest, distance = _nearest(at, here.points[own])
    near = (distance < 8.0) & (z > 0)
    if near.sum() < 20:
        return None
    ratio = (1.0 / here.inverse_depth[own][nearest] / z)[near]
    return float(np.median(ratio))


def _nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of points (M, 2) the one nearest to each query (N, 2), N > 0: its number and how far it is, some rows at once."""
    numbers, distances = [], []
    for start in range(0, len(queries), ROWS):
        distance = np.linalg.norm(queries[start : start + ROWS, None] - points[None], axis=-1)
        numbers.append(np.argmin(distance, axis=1))
        distances.append(distance.min(axis=1))
    return np.concatenate(numbers), np.concatenate(distances)


__all__ = ["PlaceMatch", "relative_scale", "verify_place", "verifying_place"]
