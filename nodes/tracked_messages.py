"""What trackers that match frames send of them: keyframes, and the frames between."""

from __future__ import annotations

import numpy as np

from msgs import Frame, Keyframe, TrackedFrame
from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.coarse_depth import coarse_map
from mvsgs_core.tracking.estimation.rolling_shutter import rectified, rectified_mask
from mvsgs_core.tracking.keyframes import Keyframe as TrackedKeyframe


def keyframe_message(
    frame: Frame,
    keyframe: TrackedKeyframe,
    intrinsics: np.ndarray,
    world_from_cam: np.ndarray,
    exposure: np.ndarray | None,
    vignetting: np.ndarray | None,
    velocity: np.ndarray | None,
    readout_time: float,
    reads_columns: bool,
) -> Keyframe:
    """A frame that became a keyframe, without its rolling shutter, and with the coarse depth of the points matched.

    intrinsics (4,) as found; velocity (6,) of the camera, without which neither photograph nor readout time is sent:
    None where it is not known, or nobody asks.
    """
    inverse_depth, weight = coarse_map(keyframe)
    return Keyframe(
        index=frame.index,
        timestamp=frame.timestamp,
        image=rectified(frame.image, keyframe.image, readout_time, reads_columns),
        intrinsics=intrinsics,
        world_from_cam=world_from_cam,
        scale=1.0,
        inverse_depth=inverse_depth,
        inverse_depth_weight=weight,
        segment=keyframe.segment,
        exposure=exposure,
        vignetting=vignetting,
        photograph=None if velocity is None else frame.image,
        velocity=velocity,
        readout_time=0.0 if velocity is None else readout_time,
        reads_columns=reads_columns,
        captured=frame.captured,
        stamp=frame.stamp,
        mask=rectified_mask(frame.mask, keyframe.image, readout_time, reads_columns),
    )


def tracked_frame_message(
    frame: Frame,
    found: Between,
    intrinsics: np.ndarray,
    scale: float,
    velocity: np.ndarray | None,
    readout_time: float,
    reads_columns: bool,
) -> TrackedFrame:
    """A frame between keyframes, with its pose from one of them, in a map of that scale.

    intrinsics (4,) as found; velocity (6,) of the camera, without which no readout time is sent: None where no neighbor
    tells it, or nobody asks.
    """
    return TrackedFrame(
        index=frame.index,
        timestamp=frame.timestamp,
        image=frame.image,
        intrinsics=intrinsics,
        keyframe=found.keyframe,
        keyframe_from_cam=found.keyframe_from_cam,
        scale=scale,
        exposure=found.exposure,
        velocity=velocity,
        readout_time=0.0 if velocity is None else readout_time,
        reads_columns=reads_columns,
        mask=frame.mask,
    )
