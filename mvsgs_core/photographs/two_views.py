"""Two photographs: which matches agree with one geometry, and where the second camera was.

An epipolar geometry (fundamental or, with a known focal length, essential matrix) must hold; a homography beside it
says whether the matches lie on a plane or the camera only turned, where the epipolar geometry alone would mean little.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MIN_MATCHES = 20  # that agree: of fewer, two photographs of different things have as many
PIXELS = 2.0  # from the epipolar line
TRIALS = 5000
IN_FRONT = 0.9  # of the most points that a pose has in front of both cameras: with fewer it is none
MIN_STEP = 1e-3  # of the distance of a plane: a camera that moved less only turned


@dataclass(frozen=True)
class TwoViews:
    """A verified pair."""

    matches: np.ndarray  # (N, 2) int64 features of the first and of the second
    fundamental: np.ndarray  # (3, 3) on pixels
    by_homography: float  # fraction of the matches that one homography explains


@dataclass(frozen=True)
class RelativePose:
    second_from_first: np.ndarray  # (4, 4), translation of length 1
    points: np.ndarray  # (N, 3) in the first camera, NaN where a match has no point in front of both
    angle: np.ndarray  # (N,) radians between the rays of a match


def verify(here: np.ndarray, there: np.ndarray, matches: np.ndarray) -> TwoViews | None:
    """The matches that agree; None where fewer than `MIN_MATCHES` do. here, there: (N, 2) and (M, 2) pixels."""
    if len(matches) < MIN_MATCHES:
        return None
    a, b = here[matches[:, 0]], there[matches[:, 1]]
    cv2.setRNGSeed(0)
    try:
        fundamental, mask = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, PIXELS, 0.9999, TRIALS)
        homography, flat = cv2.findHomography(a, b, cv2.USAC_MAGSAC, 2.0 * PIXELS, maxIters=TRIALS, confidence=0.9999)
    except cv2.error:  # OpenCV throws where it finds no model at all
        return None
    if fundamental is None or fundamental.shape != (3, 3) or mask is None:
        return None
    agree = mask.ravel() > 0
    planar = np.zeros(len(matches), bool) if homography is None or flat is None else flat.ravel() > 0
    if planar.sum() > agree.sum():  # a plane, on which the epipolar geometry is not determined
        agree = planar
    if agree.sum() < MIN_MATCHES:
        return None
    return TwoViews(matches[agree], fundamental, float((planar & agree).sum() / agree.sum()))


def relative_poses(here: np.ndarray, there: np.ndarray, focal: float, planar: bool) -> list[RelativePose]:
    """Of the second camera, by matches (N, 2) on the planes at distance 1: none where they do not tell, else one.

    That is the five-point pose (Nister 2004). Of a plane it is one of two that explain the matches as well, if all of
    the plane is nearer to one camera (Longuet-Higgins 1986): where `planar`, those of the homography (Malis and Vargas
    2007) are given instead, for a third photograph to decide. focal: pixels, for the threshold.
    """
    cv2.setRNGSeed(0)
    try:
        candidates = _of_plane(here, there, focal) if planar else _five_point(here, there, focal)
    except cv2.error:  # OpenCV throws where it finds no model at all
        return []
    found = []
    for rotation, translation in candidates:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, translation.ravel() / np.linalg.norm(translation)
        points, angle = midpoints(here, there, pose)
        found.append(RelativePose(pose, points, angle))
    front = [int(np.isfinite(pose.points[:, 0]).sum()) for pose in found]
    return [pose for pose, n in zip(found, front) if n >= max(MIN_MATCHES, IN_FRONT * max(front))]


def _five_point(here: np.ndarray, there: np.ndarray, focal: float) -> list[tuple[np.ndarray, np.ndarray]]:
    essential, mask = cv2.findEssentialMat(
        here * focal, there * focal, np.diag([focal, focal, 1.0]), cv2.USAC_MAGSAC, 0.9999, PIXELS
    )
    if essential is None or essential.shape != (3, 3):
        return []
    count, rotation, translation, _ = cv2.recoverPose(essential, here, there, np.eye(3), mask=mask)
    return [(np.asarray(rotation), np.asarray(translation))] if count >= MIN_MATCHES else []


def _of_plane(here: np.ndarray, there: np.ndarray, focal: float) -> list[tuple[np.ndarray, np.ndarray]]:
    homography, _ = cv2.findHomography(here * focal, there * focal, cv2.USAC_MAGSAC, PIXELS)
    if homography is None:
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.diag([focal, focal, 1.0]))
    return [(np.asarray(r), np.asarray(t)) for r, t in zip(rotations, translations) if np.linalg.norm(t) > MIN_STEP]


def midpoints(here: np.ndarray, there: np.ndarray, second_from_first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) halfway between two rays, NaN behind a camera, and the angles (N,) between the rays.

    second_from_first: (4, 4) or (N, 4, 4).
    """
    rotation, translation = second_from_first[..., :3, :3], second_from_first[..., :3, 3]
    ray_a = np.concatenate([here, np.ones((len(here), 1))], axis=1)
    ray_b = np.concatenate([there, np.ones((len(there), 1))], axis=1)
    ray_b = (np.swapaxes(rotation, -1, -2) @ ray_b[..., None])[..., 0]
    center = -(np.swapaxes(rotation, -1, -2) @ translation[..., None])[..., 0]
    aa, ab, bb = np.sum(ray_a * ray_a, -1), np.sum(ray_a * ray_b, -1), np.sum(ray_b * ray_b, -1)
    ac, bc = np.sum(ray_a * center, -1), np.sum(ray_b * center, -1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-15)
    s, t = (bb * ac - ab * bc) / determinant, (ab * ac - aa * bc) / determinant
    points = 0.5 * (s[:, None] * ray_a + center + t[:, None] * ray_b)
    points[(s <= 0) | (t <= 0)] = np.nan
    return points, np.arccos(np.clip(ab / np.sqrt(aa * bb), -1.0, 1.0))


__all__ = ["MIN_MATCHES", "RelativePose", "TwoViews", "midpoints", "relative_poses", "verify"]
