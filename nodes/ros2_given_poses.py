"""Where a robot's other programs say, as /tf, that its camera is: images wait for the transforms of their time."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

from msgs import Frame
from mvsgs_core.datasets.transform_tree import MOVING, STATIC, TransformTree
from mvsgs_core.stats import Stats
from nodes.ros2.cdr import CdrError
from nodes.ros2.connection import TF, Quality
from nodes.ros2.messages import TFMessage

if TYPE_CHECKING:
    from nodes.ros2.dds import Participant

PATIENCE = 0.5  # s that an image waits
MOST = 30  # images that wait
HISTORY = 10 * 10**9  # ns of transforms that are kept
STEADY = Quality(reliable=True, depth=100, transient_local=True)  # as tf2's listeners ask for it


class GivenPoses:
    """Images with the poses of their cameras in the frame `world`, the newest that has one first: those that it
    overtakes are dropped and counted."""

    def __init__(self, participant: Participant, world: str, stats: Stats) -> None:
        self._world, self._stats = world, stats
        self._tree = TransformTree(HISTORY)
        self._moving = participant.reader(MOVING, TFMessage, TF)
        self._steady = participant.reader(STATIC, TFMessage, STEADY)
        self._waiting: deque[tuple[float, str, Frame]] = deque()  # with when it came and its camera's frame

    @property
    def waits(self) -> bool:
        return bool(self._waiting)

    def add(self, frame: Frame, camera: str) -> None:
        """camera: the name of its frame of reference."""
        self._waiting.append((time.monotonic(), camera, frame))
        if len(self._waiting) > MOST:
            self._waiting.popleft()
            self._stats.count("dropped")

    def take(self) -> Frame | None:
        """The next image; without a pose where it has waited in vain. None: it waits still, or there is none."""
        self._hear()
        for newer, (_, camera, frame) in enumerate(reversed(self._waiting)):
            pose = self._tree.pose(camera, self._world, frame.stamp)
            if pose is not None:
                overtaken = len(self._waiting) - newer - 1
                self._stats.count("dropped", overtaken)
                for _ in range(overtaken + 1):
                    self._waiting.popleft()
                return replace(frame, world_from_cam=pose)
        if not self._waiting:
            return None
        came, camera, frame = self._waiting[0]
        if time.monotonic() - came < PATIENCE and self._tree.waits(camera, self._world, frame.stamp):
            return None
        self._waiting.popleft()
        self._say(camera)
        return frame

    def _hear(self) -> None:
        for reader, static in ((self._steady, True), (self._moving, False)):
            for data in reader.take():
                try:
                    self._tree.add(reader.decode(data), static)
                except CdrError as error:
                    self._stats.refuse("transforms", 1, f"what is no message of /tf was left out: {error}")
        if self._tree.refused > self._stats.counts.get("refused_transforms", 0):
            self._stats.counts["refused_transforms"] = self._tree.refused
            self._stats.warn("transforms in /tf that are none were left out")

    def _say(self, camera: str) -> None:
        self._stats.skip("images without a pose in /tf")
        if self._tree.connects(camera, self._world):
            self._stats.warn(
                f"/tf did not say, within {PATIENCE:g} s, where {camera} was in {self._world} when some images were "
                "taken: do their stamps and those of /tf come from the same clock?"
            )
        else:
            self._stats.warn(
                f"/tf does not connect {camera!r}, the camera's frame, with {self._world!r}; it has "
                f"{', '.join(self._tree.frames) or 'none'}: choose with dataset.fixed_frame and dataset.camera_frame"
            )


__all__ = ["GivenPoses"]
