"""The readout time of a rolling shutter, from the matches alone: the one that bundle adjustment agrees with best.

And images as a global shutter would have taken them, for stereo: poses and depth are all of one moment. The map is made
of the photographs as they were taken, by renders as the shutter saw them, for which it gets the camera's velocity.

Rows of an image are taken one after the other; of a phone that is held upright, whose images are turned, the columns.
A point at row v that moves at w pixels a second was seen w * readout_time * (v / H - 1/2) from where a global shutter
would have seen it in the middle of the readout, one at column u w * readout_time * (u / W - 1/2); the graph moves all
points back by that (first order in the readout time). On hand-held Kinect sequences this is most of the error.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

from mvsgs_core.camera import MAX_READOUT_TIME, is_readout_time, pixel_motion
from mvsgs_core.tracking.estimation.bundle_adjustment import Solver, adjust
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.steps import Steps

MAX_ESTIMATED = 0.035  # seconds: most cameras need less than a frame at 30 a second
TRIED = 4  # times of one direction, 0 among them
MIN_POINTS = 50  # whose depth is known: from fewer the camera's velocity is not
VELOCITY_STEPS = 5  # of iteratively reweighted least squares
MIN_GAIN = 0.02  # of the robust cost: what a global shutter gains by chance is less


class Readout(NamedTuple):
    """What is found of a rolling shutter."""

    readout_time: float  # seconds; below 0: the last row, or column, is read first; 0: a global shutter
    reads_columns: bool  # not rows


def estimating_readout(graph: KeyframeGraph, indices: Iterable[int], threads: int) -> Steps[Readout]:
    """0 s for a global shutter or where the matches hardly tell; a time that is tried a step.

    The graph's own readout where nothing can be said: an adjustment failed, or the cost has no least. The graph is left
    as it is, and is so between the steps, too.

    The shortest time is tried of all four directions, and longer ones of that of which it leaves the least cost: along
    the wrong axis a rolling shutter gains a little, too, but never as much.
    """
    order = sorted(indices)
    ways = [
        [Readout(seconds, columns) for seconds in np.linspace(0.0, last, TRIED).tolist()]
        for columns in (False, True)
        for last in (MAX_ESTIMATED, -MAX_ESTIMATED)
    ]
    still = _cost(graph, order, ways[0][0], threads)
    yield
    first = []
    for way in ways:
        first.append(_cost(graph, order, way[1], threads))
        yield
    chosen = int(np.argmin(first))
    costs = [still, first[chosen]]
    for readout in ways[chosen][2:]:
        costs.append(_cost(graph, order, readout, threads))
        yield
    best = _cheapest([readout.readout_time for readout in ways[chosen]], costs) if np.isfinite(costs).all() else None
    if best is None:
        return Readout(graph.readout_time, graph.reads_columns)
    return Readout(best, best != 0.0 and ways[chosen][0].reads_columns)


def _cost(graph: KeyframeGraph, order: list[int], readout: Readout, threads: int) -> float:
    """What bundle adjustment of these keyframes leaves with such a shutter; infinite where it fails."""
    before = graph.readout_time, graph.reads_columns
    graph.readout_time, graph.reads_columns = readout
    try:
        problem = graph.problem(order, set(order[1:]), set(order))
    finally:
        graph.readout_time, graph.reads_columns = before
    solver = Solver(steps=3, robust_scale=1.0, tolerance=0.0, threads=threads).reaching(problem)
    solution = adjust(problem, solver)
    return float("inf") if solution.failure else solution.cost


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
    of_each = pixel_motion(x, y, keyframe.inverse_depth[known], intrinsics)
    moves = np.ascontiguousarray(np.stack(of_each).transpose(2, 0, 1))  # (M, 2, 6)
    seen = flow.reshape(-1, 2)[known].astype(np.float64)
    weight = np.ones(len(seen))
    for _ in range(VELOCITY_STEPS):
        root = np.sqrt(weight)
        twist = np.linalg.lstsq((moves * root[:, None, None]).reshape(-1, 6), (seen * root[:, None]).ravel())[0]
        error = np.linalg.norm(moves @ twist - seen, axis=1)
        weight = 1.0 / np.maximum(error, max(float(np.median(error)), 1e-6))
    return twist if np.isfinite(twist).all() else None


def rectified(image: np.ndarray, frame: TrackingImage, readout_time: float, reads_columns: bool = False) -> np.ndarray:
    """An image (H, W, 3) uint8 as a global shutter would have taken it in the middle of the readout.

    frame: the same image as the tracker has it. The image itself is returned where its velocity is not known. Pixels
    that were not seen repeat those at the border.
    """
    if readout_time == 0.0 or frame.velocity is None:
        return image
    x, y = _seen_at(frame, image.shape[:2], readout_time, reads_columns)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def rectified_mask(
    mask: np.ndarray | None, frame: TrackingImage, readout_time: float, reads_columns: bool = False
) -> np.ndarray | None:
    """Pixels (H, W) bool that a mask leaves of the image as it was taken and of its `rectified` one alike."""
    if mask is None or readout_time == 0.0 or frame.velocity is None:
        return mask
    x, y = _seen_at(frame, mask.shape, readout_time, reads_columns)
    moved = cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(mask & (moved > 0))


def _seen_at(
    frame: TrackingImage, size: tuple[int, ...], readout_time: float, reads_columns: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Where in the image as it was taken (height, width) each pixel of the rectified one is: columns and rows."""
    assert frame.velocity is not None
    height, width = size
    zoom = np.array([width / frame.size[1], height / frame.size[0]], np.float32)
    velocity = cv2.resize(frame.velocity * zoom, (width, height), interpolation=cv2.INTER_LINEAR)
    u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    late = np.float32(readout_time) * ((u / width if reads_columns else v / height) - 0.5)
    return u + velocity[..., 0] * late, v + velocity[..., 1] * late


def check_readout_time(readout_time: float | None, reads_columns: bool) -> None:
    """Raises ValueError for what can't be a readout time; None: that and what is read are to be estimated."""
    if readout_time is not None and not is_readout_time(readout_time):
        raise ValueError(
            f"tracker.readout_time={readout_time:g}: it is the seconds from the first row to the last, at most "
            f"{MAX_READOUT_TIME:g} (25 milliseconds are 0.025), 0 for a global shutter, below 0 where the last row is "
            "read first; with tracker.reads_columns=true from the first column to the last, as of a phone held upright"
        )
    if readout_time is None and reads_columns:
        raise ValueError("tracker.reads_columns=true: give tracker.readout_time with it; else both are estimated")


__all__ = [
    "MAX_ESTIMATED",
    "Readout",
    "camera_velocity",
    "check_readout_time",
    "estimating_readout",
    "rectified",
    "rectified_mask",
]
