"""Frames between keyframes, to train on: they bring no splats, and stand where their keyframe stands."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.mapping.exposure import NO_EXPOSURE
from mvsgs_core.mapping.frame_of_reference import FrameOfReference
from mvsgs_core.mapping.keyframe_checks import NO_SHUTTER, checked_keyframe, is_pose, is_read_out
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.photometry import IDENTITY, compose, is_exposure
from mvsgs_core.stats import Stats

WAITING = 256  # frames, at most: a few of each of the keyframes that stereo, fusion and their buffers hold back
NO_DEPTH = np.zeros((1, 1), dtype=np.float32)


@dataclass(frozen=True)
class FrameBetween:
    """A frame that is no keyframe, as it comes to the mapper."""

    index: int
    timestamp: float  # seconds
    image: np.ndarray  # (H, W, 3) RGB as of keyframes
    intrinsics: np.ndarray  # (4,) at the image's size
    keyframe: int  # that it was posed against
    keyframe_from_cam: np.ndarray  # (4, 4) float64
    scale: float  # cumulative scale of the map, at that keyframe, that the pose is in
    exposure: np.ndarray | None = None  # (3, 4) from the keyframe's colors; None: no difference
    velocity: np.ndarray | None = None  # (6,) of the camera, as in `msgs`; None: not known
    readout_time: float = 0.0  # seconds from the image's first row to its last
    reads_columns: bool = False  # from its first column to its last, that is
    mask: np.ndarray | None = None  # (H, W) bool, False where a pixel is no part of the scene; None: all are


@dataclass
class FramesBetween:
    """Frames of a stream that wait for their keyframes, which stereo and fusion hold back, and those that were taken.

    They are given out where a keyframe is added, or the stream ends, and nowhere else: so the map does not depend on
    what is done meanwhile.
    """

    waiting: list[FrameBetween] = field(default_factory=list)
    taken: set[int] = field(default_factory=set)  # frame indices

    def wait(self, given: FrameBetween, log: Stats) -> None:
        """Beyond `WAITING` the oldest is let go, as its keyframe never came."""
        if given.index in self.taken:
            log.skip("frames between keyframes that the checkpoint has")
            return
        self.waiting.append(given)
        if len(self.waiting) > WAITING:
            del self.waiting[0]
            log.skip("frames between keyframes whose keyframe did not come")

    def take(self, keyframes: Container[int]) -> list[FrameBetween]:
        """Those whose keyframe is there now, which no longer wait."""
        found = [given for given in self.waiting if given.keyframe in keyframes]
        self.waiting = [given for given in self.waiting if given.keyframe not in keyframes]
        self.taken.update(given.index for given in found)
        return found


@dataclass
class BetweenView(TrainingView):
    """A frame between keyframes to train on; its own pose is never refined, it goes with its keyframe's."""

    keyframe: int = -1
    keyframe_from_cam: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4), in the world's unit at `scale`

    from_keyframe: np.ndarray = field(default_factory=IDENTITY.copy)  # (3, 4) exposure, from the keyframe's colors
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))  # (6,) its velocity, in the world's unit at `scale`

    def follow(self, keyframe: TrainingView, frame: FrameOfReference) -> None:
        """Stands beside the keyframe where that stands now, in its light, the map's own step of its pose included."""
        change = keyframe.scale / self.scale
        self.keyframe_from_cam = geometry.scaled(self.keyframe_from_cam, change)
        self.twist = geometry.twist_scaled(self.twist, change)
        self.velocity = geometry.twist_scaled(self.twist, 1.0 / frame.length)
        self.scale = keyframe.scale
        self.world_from_cam = keyframe.world_from_cam @ self.keyframe_from_cam
        local = keyframe.local_from_cam
        relative = geometry.scaled(self.keyframe_from_cam, 1.0 / frame.length)
        self.local_from_cam = local @ relative
        self.pose_delta = geometry.inverse(relative) @ keyframe.pose_delta @ relative
        self.take_exposure(None if keyframe.measured is None else compose(self.from_keyframe, keyframe.measured))


def between_view(
    given: FrameBetween, keyframe: TrainingView, frame: FrameOfReference, max_pixels: int | None,
    device: torch.device, log: Stats,
) -> BetweenView | None:  # fmt: skip
    """To train on beside its keyframe; None, and counted, where no camera gives it."""
    checked = checked_keyframe(
        RGBDKeyframe(
            index=given.index, timestamp=given.timestamp, image=given.image, intrinsics=given.intrinsics,
            world_from_cam=given.keyframe_from_cam, depth=NO_DEPTH, scale=given.scale, mask=given.mask,
        ),
        log,
    )  # fmt: skip
    if checked is None:
        return None
    plain = training_view(checked, np.eye(4), max_pixels, device)
    view = BetweenView(
        **vars(plain), keyframe=given.keyframe, keyframe_from_cam=np.asarray(given.keyframe_from_cam, dtype=np.float64)
    )
    view.fixed = True
    if given.velocity is not None:
        if is_read_out(given.velocity, given.readout_time):
            view.twist, view.readout_time = given.velocity, given.readout_time
            view.reads_columns = given.reads_columns
        else:
            log.refuse("photographs", 1, NO_SHUTTER)
    if given.exposure is not None:
        if is_exposure(given.exposure):
            view.from_keyframe = given.exposure.astype(np.float32)
        else:
            log.refuse("exposures", 1, NO_EXPOSURE)
    view.follow(keyframe, frame)
    if not (is_pose(view.world_from_cam, view.scale) and frame.holds(view.world_from_cam)):
        log.refuse("views", 1, "a frame between keyframes far away from them was refused")
        return None
    return view


__all__ = ["BetweenView", "FrameBetween", "FramesBetween", "between_view"]
