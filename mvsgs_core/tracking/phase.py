"""What a tracker is doing, from frame to frame."""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    INITIALIZING = "initializing"  # this segment has no map yet: keyframes are collected until they can be solved
    TRACKING = "tracking"  # each frame's pose is found from a keyframe's points
    RELOCALIZING = "relocalizing"  # the frame could not be followed: the map is searched for the camera
    LOST = "lost"  # nor is there anything to search with: the image has no texture, as of a covered lens


__all__ = ["Phase"]
