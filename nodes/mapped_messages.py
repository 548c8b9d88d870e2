"""What the mapper takes in, as its core has it."""

from __future__ import annotations

from msgs import FusedKeyframe, Keyframe, TrackedFrame
from mvsgs_core.mapping.between import FrameBetween
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.provisional import CoarseKeyframe


def rgbd_keyframe(fused: FusedKeyframe) -> RGBDKeyframe:
    return RGBDKeyframe(
        index=fused.index, image=fused.image, intrinsics=fused.intrinsics, world_from_cam=fused.world_from_cam,
        depth=fused.depth, scale=fused.scale, confidence=fused.confidence, normals=fused.normals,
        unfiltered=fused.unfiltered, timestamp=fused.timestamp, exposure=fused.exposure,
        vignetting=fused.vignetting, photograph=fused.photograph, velocity=fused.velocity,
        readout_time=fused.readout_time, reads_columns=fused.reads_columns, mask=fused.mask,
    )  # fmt: skip


def frame_between(frame: TrackedFrame) -> FrameBetween:
    return FrameBetween(
        index=frame.index, timestamp=frame.timestamp, image=frame.image, intrinsics=frame.intrinsics,
        keyframe=frame.keyframe, keyframe_from_cam=frame.keyframe_from_cam, scale=frame.scale,
        exposure=frame.exposure, velocity=frame.velocity, readout_time=frame.readout_time,
        reads_columns=frame.reads_columns, mask=frame.mask,
    )  # fmt: skip


def coarse_keyframe(keyframe: Keyframe) -> CoarseKeyframe:
    return CoarseKeyframe(
        index=keyframe.index, image=keyframe.image, intrinsics=keyframe.intrinsics, scale=keyframe.scale,
        world_from_cam=keyframe.world_from_cam, inverse_depth=keyframe.inverse_depth,
        weight=keyframe.inverse_depth_weight, segment=keyframe.segment, exposure=keyframe.exposure,
    )  # fmt: skip


__all__ = ["coarse_keyframe", "frame_between", "rgbd_keyframe"]
