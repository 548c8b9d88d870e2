"""A held-out frame's camera, fitted to its photograph at test time: pose and exposure, on the finished map.

ARTDECO, PLANING and OnTheFly-NVS score in this way: what is left is the map's error without that of the pose and the
exposure that the run gave the frame. The map is only rendered. Direct image alignment (Lucas and Kanade 1981) by
Levenberg-Marquardt over a twist of the camera and an affine of the colors, at half the resolution first; the error is
the one that PSNR measures, and a step that does not lower it is not taken: no frame gets worse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvsgs_core import camera, geometry
from mvsgs_core.evaluation.scoring import Rendered, ScoredFrame, render_frame
from mvsgs_core.photometry import vignetting_factor
from mvsgs_core.rasterizer.splats import Splats

SMALLEST = 24  # pixels of the shorter side, below which a resolution is left out
RENDERS = 8  # at each of the two resolutions, beside the first
CONVERGED = 1e-3  # fall of the error, as a fraction, that a step must promise and bring, or it ends: 0.004 dB
REFUSED = 3  # steps in a row that do not lower the error, at which it ends
DAMPING = 1e-3  # of the first step, as a fraction of the diagonal
FLOOR = 1e-6  # of the diagonal, a pixel: what the photograph does not show stays as it is
SAMPLES = 80_000  # pixels, about, that the normal equations are summed over; the error is always that of all
MOTION = 6  # unknowns: translation in median depths and rotation of the camera; then the rows of the color affine


@dataclass(frozen=True)
class _State:
    frame: ScoredFrame
    seen: Rendered
    error: float  # mean squared difference of render and photograph


def fit_camera(splats: Splats, kernel: str, frame: ScoredFrame) -> ScoredFrame:
    """The frame with the pose and the exposure from which the map shows its photograph best; the rest as it was."""
    photograph, mask = frame.photograph().astype(np.float32) / 255.0, frame.mask()
    if mask is not None:
        photograph[~mask] = np.nan
    height, width = photograph.shape[:2]
    found = frame
    for size in (((height + 1) // 2, (width + 1) // 2), (height, width)):
        if min(size) < SMALLEST:
            continue
        intrinsics = camera.scale_intrinsics(frame.intrinsics, (height, width), size)
        target = camera.resize_image(photograph, size)
        starts = [frame] if found is frame else [frame, found]  # what was coarsely found has to hold here
        seen = [_seen(splats, kernel, replace(start, intrinsics=intrinsics), target) for start in starts]
        found = _aligned(splats, kernel, min(seen, key=lambda state: state.error), target)
    return replace(frame, world_from_cam=found.world_from_cam, exposure=found.exposure)


def _aligned(splats: Splats, kernel: str, best: _State, target: np.ndarray) -> ScoredFrame:
    """Levenberg-Marquardt (Marquardt 1963) from a state on, at the resolution of `target` (H, W, 3)."""
    damping, refused = DAMPING, 0
    linear = linearized(best.seen, target, best.frame)
    for _ in range(RENDERS):
        step = np.linalg.solve(linear.hessian + damping * np.diag(np.diag(linear.hessian)), linear.gradient)
        if linear.fall(step) < CONVERGED:
            break
        trial = _seen(splats, kernel, _moved(best.frame, step, linear.length), target)
        fall = (best.error - trial.error) / max(best.error, 1e-12)
        if fall > 0.0:
            best, damping, refused = trial, 0.1 * damping, 0
            if fall < CONVERGED:
                break
            linear = linearized(best.seen, target, best.frame)
        else:
            damping, refused = 10.0 * damping, refused + 1
            if refused == REFUSED:
                break
    return best.frame


@dataclass(frozen=True)
class Linear:
    """Normal equations of the residuals photograph - render in the 18 unknowns, over a grid of pixels."""

    hessian: np.ndarray  # (18, 18) float64
    gradient: np.ndarray  # (18,) float64
    squares: float  # sum of the squared residuals
    length: float  # map units in one of the translation's

    def fall(self, step: np.ndarray) -> float:
        """Of the error, as a fraction, that a step (18,) promises."""
        return float(step @ (2.0 * self.gradient - self.hessian @ step)) / max(self.squares, 1e-12)


def linearized(seen: Rendered, target: np.ndarray, frame: ScoredFrame) -> Linear:
    """Of a render against its photograph (H, W, 3), NaN where that does not count, with intrinsics at that size.

    The render follows the camera as the pixels of a still scene of its depth do; where nothing is rendered, or a color
    is cut off at 0 or 1, it follows nothing.
    """
    every = max(1, round((seen.depth.size / SAMPLES) ** 0.5))

    def taken(image: np.ndarray) -> np.ndarray:
        """(C, N) of the grid, for an image (H, W, C): its planes one after the other."""
        return np.ascontiguousarray(image[every // 2 :: every, every // 2 :: every].reshape(-1, image.shape[2]).T)

    (depth,) = taken(seen.depth[..., None])
    known = np.isfinite(depth) & (depth > 0)
    length = float(np.median(depth[known])) if known.any() else 1.0
    u, v = (taken(axis[..., None])[0] for axis in camera.pixel_grid(*seen.depth.shape))
    fx, fy, cx, cy = frame.intrinsics
    seen_at = (u - cx) / fx, (v - cy) / fy, length / np.where(known, depth, np.inf)
    x, y, near = (values.astype(np.float32) for values in seen_at)
    of_u, of_v = camera.pixel_motion(x, y, near, frame.intrinsics)  # by a twist whose translation is in `length`
    of_u[:, ~known] = of_v[:, ~known] = 0.0
    factor = np.ones_like(seen.depth)[..., None]
    if frame.vignetting is not None:  # of the camera: it comes after the affine and does not move with the scene
        factor = factor * vignetting_factor(frame.vignetting, frame.intrinsics, target.shape[:2])[..., None]
    rows, columns = (taken(factor * slope) for slope in np.gradient(seen.color / factor, axis=(0, 1)))
    color, unit, residuals = taken(seen.color), taken(factor), taken(target - seen.color)
    jacobian = np.empty((MOTION + 4, len(depth)), dtype=np.float32)
    count = MOTION + 4 * len(color)
    hessian, gradient, squares = np.zeros((count, count)), np.zeros(count), 0.0
    for channel, residual in enumerate(residuals):
        jacobian[:MOTION] = -(columns[channel] * of_u + rows[channel] * of_v)
        jacobian[MOTION:-1], jacobian[-1] = color, unit
        jacobian[:, (color[channel] <= 0.0) | (color[channel] >= 1.0) | np.isnan(residual)] = 0.0
        residual = np.nan_to_num(residual)
        unknowns = np.r_[0:MOTION, MOTION + 4 * channel : MOTION + 4 * channel + 4]
        hessian[np.ix_(unknowns, unknowns)] += jacobian @ jacobian.T
        gradient[unknowns] += jacobian @ residual
        squares += float(residual @ residual)
    return Linear(hessian + FLOOR * len(depth) * np.eye(count), gradient, squares, length)


def _moved(frame: ScoredFrame, step: np.ndarray, length: float) -> ScoredFrame:
    twist = geometry.twist_scaled(step[:MOTION], length)
    change = np.eye(4)
    change[:3] += step[MOTION:].reshape(3, 4)
    exposure = np.eye(4)
    if frame.exposure is not None:
        exposure[:3] = frame.exposure
    pose = frame.world_from_cam @ geometry.se3_exp(twist)
    return replace(frame, world_from_cam=pose, exposure=(change @ exposure)[:3].astype(np.float32))


def _seen(splats: Splats, kernel: str, frame: ScoredFrame, target: np.ndarray) -> _State:
    seen = render_frame(splats, kernel, frame, (target.shape[0], target.shape[1]))
    return _State(frame, seen, float(np.nanmean((seen.color - target) ** 2, dtype=np.float64)))


__all__ = ["Linear", "fit_camera", "linearized"]
