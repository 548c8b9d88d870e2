"""The readout time of a rolling shutter, from the matches alone: the one that bundle adjustment agrees with best.

And images as a global shutter would have taken them, for stereo: poses and depth are all of one moment. The map is made
of the photographs as they were taken, by renders as the shutter saw them, for which it gets the camera's velocity.

Rows of an image are taken one after the other. A point at row v that moves at w pixels a second was seen
w * readout_time * (v / H - 1/2) from where a global shutter would have seen it in the middle of the readout; the
graph moves all points back by that (first order in the readout time). On hand-held Kinect sequences this is most of
the error.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from mvsgs_core.camera import MAX_READOUT_TIME, is_readout_time
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, adjust
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.steps import Steps, whole

MAX_ESTIMATED = 0.035  # seconds: most cameras need less than a frame at 30 a second
MIN_POINTS = 50  # whose depth is known: from fewer the camera's velocity is not
VELOCITY_STEPS = 5  # of iteratively reweighted least squares
MIN_GAIN = 0.02  # of the robust cost: what a global shutter gains by chance is less


def estimate_readout_time(graph: KeyframeGraph, indices: Iterable[int], threads: int) -> float:
    """Seconds, 0 for a global shutter or where the matches hardly tell. Leaves the graph as it is.

    Below 0 the last row is read first, which is tried where no time above 0 is any better. The graph's own readout time
    where nothing can be said: an adjustment failed, or the cost has no least.
    """
    return whole(estimating_readout_time(graph, indices, threads))


def estimating_readout_time(graph: KeyframeGraph, indices: Iterable[int], threads: int) -> Steps[float]:
    """`estimate_readout_time`, a time that is tried a step; the graph is as it was between them, too."""
    order = sorted(indices)
    costs: dict[float, float] = {}  # by the time that was tried
    found: float | None = None
    for last in (MAX_ESTIMATED, -MAX_ESTIMATED):
        tried = [float(seconds) for seconds in np.linspace(0.0, last, 4)]
        for seconds in tried:
            if seconds not in costs:
                cost = _cost(graph, order, seconds, threads)
                if cost is None:
                    return graph.readout_time
                costs[seconds] = cost
                yield
        best = _cheapest(tried, [costs[seconds] for seconds in tried])
        if best:
            return best
        found = best if found is None else found
    return graph.readout_time if found is None else found


def _cost(graph: KeyframeGraph, order: list[int], readout_time: float, threads: int) -> float | None:
    """What bundle adjustment of these keyframes leaves with such a readout time; None where it fails."""
    before, graph.readout_time = graph.readout_time, readout_time
    try:
        problem = graph.problem(order, set(order[1:]), set(order))
    finally:
        graph.readout_time = before
    solution = adjust(problem, Solver(steps=3, robust_scale=1.0, tolerance=0.0, threads=threads))
    return None if solution.failure else solution.cost


def _cheapest(tried: list[float], costs: list[float]) -> float | None:
    """The time between 0, the first that was tried, and the last whose cost is least, by a parabola.

    0 where it is hardly less than without a shutter; None where the parabola has no least.
    """
    bend, slope, level = np.polyfit(tried, costs, 2)
    if bend <= 0.0:
        return None
    best = float(np.clip(-0.5 * slope / bend, min(tried), max(tried)))
    gain = level - float(np.polyval([bend, slope, level], best))
    return best if gain > MIN_GAIN * costs[0] else 0.0


def camera_velocity(keyframe: Keyframe, intrinsics: np.ndarray) -> np.ndarray | None:
    """(6,) twist (translation, rotation) a second in the camera's axes, in the unit of the keyframe's depths.

    That which moves its points of known depth as the image moves, by least absolute errors; None where either is not
    known. intrinsics: (4,) of the tracker's images.
    """
    flow, known = keyframe.image.velocity, keyframe.triangulated
    if flow is None or known.sum() < MIN_POINTS:
        return None
    fx, fy, cx, cy = intrinsics
    x, y = ((keyframe.points[known] - [cx, cy]) / [fx, fy]).T
    near, zero = keyframe.inverse_depth[known], np.zeros(int(known.sum()))
    # how the image moves with the camera: the interaction matrix of visual servoing (Chaumette and Hutchinson 2006)
    of_u = np.stack([-near, zero, x * near, x * y, -(1.0 + x * x), y], axis=1) * fx
    of_v = np.stack([zero, -near, y * near, 1.0 + y * y, -x * y, -x], axis=1) * fy
    moves = np.stack([of_u, of_v], axis=1)  # (M, 2, 6)
    seen = flow.reshape(-1, 2)[known].astype(np.float64)
    weight = np.ones(len(seen))
    for _ in range(VELOCITY_STEPS):
        root = np.sqrt(weight)
        twist = np.linalg.lstsq((moves * root[:, None, None]).reshape(-1, 6), (seen * root[:, None]).ravel())[0]
        error = np.linalg.norm(moves @ twist - seen, axis=1)
        weight = 1.0 / np.maximum(error, max(float(np.median(error)), 1e-6))
    return twist if np.isfinite(twist).all() else None


def rectified(image: np.ndarray, frame: TrackingImage, readout_time: float) -> np.ndarray:
    """An image (H, W, 3) uint8 as a global shutter would have taken it in the middle of the readout.

    frame: the same image as the tracker has it. The image itself is returned where its velocity is not known. Pixels
    that were not seen repeat those at the border.
    """
    if readout_time == 0.0 or frame.velocity is None:
        return image
    x, y = _seen_at(frame, image.shape[:2], readout_time)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def rectified_mask(mask: np.ndarray | None, frame: TrackingImage, readout_time: float) -> np.ndarray | None:
    """Pixels (H, W) bool that a mask leaves of the image as it was taken and of its `rectified` one alike."""
    if mask is None or readout_time == 0.0 or frame.velocity is None:
        return mask
    x, y = _seen_at(frame, mask.shape, readout_time)
    moved = cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(mask & (moved > 0))


def _seen_at(frame: TrackingImage, size: tuple[int, ...], readout_time: float) -> tuple[np.ndarray, np.ndarray]:
    """Where in the image as it was taken (height, width) each pixel of the rectified one is: columns and rows."""
    assert frame.velocity is not None
    height, width = size
    zoom = np.array([width / frame.size[1], height / frame.size[0]], np.float32)
    velocity = cv2.resize(frame.velocity * zoom, (width, height), interpolation=cv2.INTER_LINEAR)
    u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    late = np.float32(readout_time) * (v / height - 0.5)
    return u + velocity[..., 0] * late, v + velocity[..., 1] * late


def check_readout_time(readout_time: float | None) -> None:
    """Raises ValueError for what can't be a readout time; None is to be estimated."""
    if readout_time is not None and not is_readout_time(readout_time):
        raise ValueError(
            f"tracker.readout_time={readout_time:g}: it is the seconds from the first row to the last, at most "
            f"{MAX_READOUT_TIME:g} (25 milliseconds are 0.025), 0 for a global shutter, below 0 where the last row is "
            "read first"
        )


__all__ = [
    "MAX_ESTIMATED",
    "camera_velocity",
    "check_readout_time",
    "estimate_readout_time",
    "estimating_readout_time",
    "rectified",
    "rectified_mask",
]
