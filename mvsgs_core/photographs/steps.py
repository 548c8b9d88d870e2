"""How wide the steps between successive pictures are: whether they are photographs, or frames of a video.

A step is wide where the points of a picture are not found again in the next as those of a video's frames are, or where
these two pictures alone say how far the points are: then each shows what none between two others has to, and matches
that ask for no small step find more. Measured on the video tracker's own image, with the flow that it follows.
Steps in which nothing moves are of a camera that stands, or of several exposures of one photograph: they tell nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.photographs.reconstruction import PLANE
from mvsgs_core.photographs.sparse_map import MIN_ANGLE
from mvsgs_core.photographs.two_views import relative_poses
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.image import TrackingImage, tracking_size
from mvsgs_core.tracking.matching.flow import refined_inverse_search

PAIRS = 12  # of successive pictures that are looked at, at most, where something moves
MORE = 24  # pairs that are looked at beside them, at most, where nothing moves in some
STILL, FULL = 0.5, 0.9  # pixels of the tracking image, median, and fraction of points found, where nothing moves
PIXELS = 1.0  # of the tracking image: matches within it of one homography lie on a plane, or the camera only turned
WIDE = 1 / 3  # of the steps: where more are wide, who follows the points from picture to picture loses the camera
MOST = 500  # pictures: of more, whatever their steps, nobody wants to wait for the last one without having said so
ENOUGH = 4 * TrackerConfig().area  # pixels of a picture that is scaled to the tracking image


@dataclass(frozen=True)
class Step:
    """From one picture to the next."""

    found: float  # of the textured points, fraction that the flow found again
    angle: float  # radians between the rays of a match, median; 0 where the matches tell no pose
    flow: float  # pixels of the tracking image that points moved by, median; 0 where none was found again

    @property
    def still(self) -> bool:
        return self.found > FULL and self.flow < STILL

    @property
    def lost(self) -> bool:
        return self.found < TrackerConfig().front_end.lost_fraction

    @property
    def wide(self) -> bool:
        return self.lost or self.angle > MIN_ANGLE


@dataclass(frozen=True)
class Steps:
    """Those that were looked at, spread over the sequence."""

    steps: list[Step]

    @property
    def moving(self) -> list[Step]:
        return [step for step in self.steps if not step.still]

    @property
    def wide(self) -> bool:
        """False where none tells anything, too."""
        # few of many that move say little: a camera may have stood, and then have moved fast
        return sum(step.wide for step in self.moving) > WIDE * min(PAIRS, len(self.steps))

    def __str__(self) -> str:
        moving = self.moving
        angles = [np.degrees(step.angle) for step in moving if not step.lost]
        between = f", {np.median(angles):.1f} degrees between the rays of a point" if angles else ""
        found = 100.0 * np.median([step.found for step in moving])
        wide, still = sum(step.wide for step in moving), len(self.steps) - len(moving)
        others = f"; in {still} others nothing moves" if still else ""
        return (
            f"{wide} of {len(moving)} steps between pictures are wide ({found:.0f} % of points found{between}{others})"
        )


def chosen_pairs(count: int) -> list[int]:
    """First pictures of the pairs that may be looked at, of a sequence of `count`: PAIRS, in order, then the others."""
    if count < 2:
        return []
    spread = sorted({int(n) for n in np.linspace(0, count - 2, min(PAIRS, count - 1))})
    # as by chance, and never in step with photographs of which each was taken several times
    others = dict.fromkeys((np.arange(1, 10 * MORE) * 0.6180339887 % 1.0 * (count - 1)).astype(int).tolist())
    return spread + [n for n in others if n not in spread][:MORE]


def measure_steps(pairs: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Steps:
    """pairs: two RGB images (H, W, 3) uint8 of one size, and intrinsics (4,) of them, as guessed if they are not known.

    Pictures in which there is nothing to follow tell nothing and are left out. Ends when PAIRS move.
    """
    steps, moving = [], 0
    for pair in pairs:
        step = measure_step(*pair)
        if step is not None:
            steps.append(step)
            moving += not step.still
        if moving == PAIRS:
            break
    return Steps(steps)


def measure_step(first: np.ndarray, second: np.ndarray, intrinsics: np.ndarray) -> Step | None:
    """See `measure_steps`."""
    config = TrackerConfig()
    size = tracking_size(first.shape[0], first.shape[1], config.area)
    here, there = (TrackingImage.of(n, 0.0, image, size, False) for n, image in enumerate((first, second)))
    points, textured = here.cells.points.astype(np.float64), here.cells.textured
    if textured.mean() < config.min_texture:
        return None
    matches = refined_inverse_search().match(here, there, points, points)
    good = matches.alive & textured
    scaled = scale_intrinsics(intrinsics, (first.shape[0], first.shape[1]), size)
    angle = _angle(points[good], matches.target[good], scaled)
    moved = np.linalg.norm(matches.target[good] - points[good], axis=1)
    return Step(float(good.sum() / textured.sum()), angle, float(np.median(moved)) if len(moved) else 0.0)


def _angle(here: np.ndarray, there: np.ndarray, intrinsics: np.ndarray) -> float:
    """Radians; of two poses that explain a plane as well, the smaller. here, there: (N, 2) pixels."""
    cv2.setRNGSeed(0)
    try:
        _, flat = cv2.findHomography(here, there, cv2.USAC_MAGSAC, PIXELS)
    except cv2.error:  # OpenCV throws where there are too few
        return 0.0
    planar = flat is not None and float(np.mean(flat)) > PLANE
    rays = [(pixels - intrinsics[2:]) / intrinsics[:2] for pixels in (here, there)]
    poses = relative_poses(rays[0], rays[1], float(intrinsics[:2].mean()), planar)
    angles = [np.median(pose.angle[np.isfinite(pose.points).all(axis=1)]) for pose in poses]
    return float(min(angles, default=0.0))


__all__ = ["Step", "Steps", "chosen_pairs", "measure_step", "measure_steps"]
