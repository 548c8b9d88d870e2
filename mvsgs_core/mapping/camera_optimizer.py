"""Adam on what belongs to a keyframe's camera and not to the map: its pose."""

from __future__ import annotations

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.optimizer import BETA_1, BETA_2


def step_pose(view: TrainingView, gradient: np.ndarray, angle: float, length: float) -> bool:
    """Adam on the pose: composes the view's `pose_delta` with a twist in the camera's frame, in float64.

    gradient: (6,) of the loss by (translation, rotation) of the camera's frame. angle, length: the rates, radians and
    the mapper's unit a step. Returns False, and leaves all as it was, where the gradient is not finite.
    """
    if not np.isfinite(gradient).all():
        return False
    rates = np.array([length] * 3 + [angle] * 3)
    view.pose_steps += 1
    first, second = view.pose_moments
    first[:] = BETA_1 * first + (1 - BETA_1) * gradient
    second[:] = BETA_2 * second + (1 - BETA_2) * gradient**2
    mean, square = first / (1 - BETA_1**view.pose_steps), second / (1 - BETA_2**view.pose_steps)
    twist = -rates * mean / (np.sqrt(square) + 1e-15)
    view.pose_delta = view.pose_delta @ geometry.se3_exp(twist)
    return True
