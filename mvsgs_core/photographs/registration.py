"""The pose of one photograph against points of known place: PnP, then the least robust error."""

from __future__ import annotations

import cv2
import numpy as np

from mvsgs_core.photographs.adjustment import SparseProblem, adjust_sparse
from mvsgs_core.photographs.lens import SharedLens

MIN_SEEN = 20  # points that agree with the pose
MIN_AGREE = 0.25  # of those that were matched
MAX_ERROR = 4.0  # pixels of an observation that agrees
BENT = 3.0  # times as many where the map may be bent, as it is far from where it began
ROBUST = 1.0  # pixels
TRIALS = 2000


def register(
    photograph: int, points: np.ndarray, pixels: np.ndarray, lens: SharedLens, max_error: float = MAX_ERROR
) -> np.ndarray | None:
    """cam_from_world (4, 4) of a photograph that sees points (N, 3) at pixels (N, 2); None where too few agree.

    max_error: pixels of a point that agrees.
    """
    if len(points) < MIN_SEEN:
        return None
    focal = lens.focal(photograph)
    flat = lens.unproject(np.full(len(points), photograph), pixels) * focal
    cv2.setRNGSeed(0)
    camera = np.diag([focal, focal, 1.0])
    try:
        found, _, _, inliers = cv2.solvePnPRansac(
            points, flat, camera, None,
            iterationsCount=TRIALS, reprojectionError=max_error, confidence=0.9999, flags=cv2.SOLVEPNP_P3P,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < max(MIN_SEEN, MIN_AGREE * len(points)):
            return None
        # RANSAC ends with EPnP, which of points on a plane may find the wrong one of two minima: SQPnP does not
        agree = inliers.ravel()
        found, turn, shift = cv2.solvePnP(points[agree], flat[agree], camera, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # OpenCV throws where the points are no configuration for it
        return None
    if not found:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    if not np.isfinite(pose).all():
        return None
    seen = agree[((points[agree] @ pose[:3, :3].T + pose[:3, 3])[:, 2]) > 0.0]
    if len(seen) < MIN_SEEN:
        return None
    one = SharedLens(lens.intrinsics[photograph][None], lens.factor, lens.k1, lens.k2)
    alone = SparseProblem(
        pose[None], points[seen], one, np.zeros(len(seen), np.int64), np.arange(len(seen)), pixels[seen],
        free_pose=np.ones(1, bool), free_points=False,
    )  # fmt: skip
    return np.asarray(adjust_sparse(alone, 10, ROBUST).cam_from_world[0])


__all__ = ["BENT", "MAX_ERROR", "MIN_SEEN", "ROBUST", "register"]
