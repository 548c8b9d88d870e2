"""The mapper's state as a map at rest, in world units."""

from __future__ import annotations

import math

import numpy as np
import torch

from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.exposure import relative_to_mean
from mvsgs_core.mapping.frame_of_reference import FrameOfReference
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.photometry import IDENTITY
from mvsgs_core.rasterizer.splats import Splats


def snapshot(
    state: MapState,
    views: list[TrainingView],
    frame: FrameOfReference,
    kernel: str,
    iterations: int,
    vignetting: np.ndarray | None = None,
    antialiased: bool = False,
    background: np.ndarray | None = None,
) -> Snapshot:
    """The state in world units."""
    local = state.detached()
    length = frame.length
    splats = Splats(**{name: value.cpu().clone() for name, value in local.tensors().items()})
    splats.means = (splats.means.to(torch.float64) * length).to(torch.float32)
    splats.log_scales = splats.log_scales + math.log(length)
    count = len(views)
    exposures = np.array([v.exposure.cpu().numpy() for v in views], dtype=np.float32).reshape(-1, 3, 4)
    if count and not np.array_equal(exposures, np.broadcast_to(IDENTITY, exposures.shape)):
        if background is not None:
            mean = exposures.mean(axis=0)
            background = mean[:, :3] @ background + mean[:, 3]
        splats.sh, exposures = relative_to_mean(splats, exposures)
    return Snapshot(
        splats=splats,
        anchors=state.anchors.cpu().numpy().copy(),
        origin=np.zeros(3) if frame.origin is None else frame.origin.copy(),
        kernel=kernel,
        iterations=iterations,
        keyframes=np.array([view.index for view in views], dtype=np.int64),
        world_from_cam=np.stack([_refined(v, length) for v in views]) if count else np.zeros((0, 4, 4)),
        scale=np.array([view.scale for view in views], dtype=np.float64),
        exposures=exposures,
        vignetting=None if vignetting is None else vignetting.astype(np.float32),
        antialiased=antialiased,
        background=background,
    )


def _refined(view: TrainingView, length: float) -> np.ndarray:
    delta = view.pose_delta.copy()
    delta[:3, 3] *= length
    return view.world_from_cam @ delta
