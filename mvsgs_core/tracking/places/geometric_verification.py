"""Geometric verification of a place: an old keyframe in an image, with no idea of the pose.

Features, then Lucas-Kanade, then a pose that must meet the criteria.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core import geometry
from mvsgs_core.camera import matrix
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.features import match_features
from mvsgs_core.tracking.matching.flow import Matches, propagate
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.localization import Localization, localize
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.steps import Steps, whole

MAX_DOUBT = 0.2  # of a place's depths, for errors of a pixel: beyond, as where a camera turned, they tell no scale


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
    guess = propagate(from_keyframe, in_image - from_keyframe, keyframe.points, 3, 0.15 * image.size[1])
    matches, fraction = matcher.match(keyframe.image, image, guess, 0.0)
    known = matches.alive & keyframe.triangulated
    if fraction < criteria.min_fraction or known.sum() < criteria.min_matches:
        return None
    yield
    u, v = keyframe.points[known].T.astype(np.float64)
    fx, fy, cx, cy = graph.intrinsics
    depth = 1.0 / keyframe.inverse_depth[known]
    points = np.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], axis=1)
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points,
        matches.target[known],
        matrix(graph.intrinsics),
        np.zeros(4),
        iterationsCount=200,
        reprojectionError=3.0,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found:
        return None
    relative = np.eye(4)
    relative[:3, :3], relative[:3, 3] = geometry.so3_exp(rotation.ravel()), translation.ravel()
    localization = localize(graph, index, matches, relative @ keyframe.cam_from_world, Solver(steps=10))
    if not criteria.accept(graph, index, matches, localization):
        return None
    return PlaceMatch(index, matches, localization)


@dataclass(frozen=True)
class RelativeScale:
    """Unit of a keyframe's own depths over the unit of a place's keyframe.

    The sigmas are of a point, not of many: points of a keyframe share its baseline, so they err together.
    """

    value: float
    sigma: float  # of its logarithm, for errors of a pixel
    place_sigma: float  # what the place's depths have in that: of what is found by them, as a fraction


def relative_scale(graph: KeyframeGraph, place: PlaceMatch, index: int) -> RelativeScale | None:
    """That of keyframe `index`, which sees the place; None where too few points compare, or depths say too little."""
    here, seen = graph.keyframes[index], graph.keyframes[place.index]
    usable = np.flatnonzero(place.matches.alive & seen.triangulated)
    own = np.flatnonzero(here.triangulated)
    if len(usable) < 20 or len(own) < 20:
        return None
    relative = place.localization.cam_from_world @ graph.world_from_cam(place.index)
    fx, fy, cx, cy = graph.intrinsics
    u, v = seen.points[usable].T.astype(np.float64)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)])
    z = relative[2, :3] @ rays / seen.inverse_depth[usable] + relative[2, 3]
    at = place.matches.target[usable]
    distance = np.linalg.norm(at[:, None] - here.points[own][None], axis=-1)
    nearest = np.argmin(distance, axis=1)
    near = (distance[np.arange(len(at)), nearest] < 8.0) & (z > 0)
    if near.sum() < 20:
        return None
    there, beside = usable[near], own[nearest[near]]
    variance_there = 1.0 / (seen.information * seen.inverse_depth**2)[there]
    variance = variance_there + 1.0 / (here.information * here.inverse_depth**2)[beside]
    sigma, place_sigma = (float(np.sqrt(np.median(v))) for v in (variance, variance_there))
    if place_sigma > MAX_DOUBT:
        return None
    return RelativeScale(float(np.median(1.0 / here.inverse_depth[beside] / z[near])), sigma, place_sigma)


__all__ = ["PlaceMatch", "RelativeScale", "relative_scale", "verify_place", "verifying_place"]
