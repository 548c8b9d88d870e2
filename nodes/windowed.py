"""What stereo and fusion share as nodes: their core holds the newest keyframes, whose poses the tracker corrects."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from msgs import Asked, Depth, FusedKeyframe, Keyframe, Poses, Request, TrackedFrame
from mvsgs_core import geometry
from mvsgs_core.keyframe_window import Correction, WindowedKeyframe
from mvsgs_core.pace import Pace
from nodes import Node
from nodes.once import Once

# requests before which the map gets each keyframe that the tracker had sent
CLOSING = (Asked.SAVE_MAP, Asked.RESET, Asked.LOAD_MAP, Asked.LOCALIZE)
PATIENCE = 0.5  # s that a live keyframe waits for later ones


class WindowedCore(Protocol):
    @property
    def pace(self) -> Pace: ...

    @property
    def waiting(self) -> int | None: ...

    def move(self, poses: dict[int, Correction]) -> None: ...

    def release(self) -> Iterator[Any]: ...

    def flush(self) -> Iterator[Any]: ...

    def forget(self) -> None: ...


Core = TypeVar("Core", bound=WindowedCore)
Found = TypeVar("Found")  # what the core finds of a keyframe
Sent = TypeVar("Sent", Depth, FusedKeyframe)  # the message of it
K = TypeVar("K", bound=WindowedKeyframe)


class WindowedNode(Node, ABC, Generic[Core, Found, Sent]):
    """A subclass makes the core from its Config, feeds it, and makes messages of what it finds."""

    step: ClassVar[str]  # name of the core's work in the times of the report
    restartable: ClassVar[bool] = True

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._core = self._make_core()
        self._once = Once(self.stats)
        self._core.pace.log = self.stats
        self._core.pace.waiting = self._queue
        self._came: dict[int, float] = {}  # when keyframes came that wait for later ones, by a clock of its own
        self._poses: dict[int, Correction] = {}  # newest of each keyframe
        self._exposures: dict[int, np.ndarray] = {}  # (3, 4), the same
        self._vignetting: np.ndarray | None = None  # (3,) the newest
        # newest, each with its scale, and time and axis of the readout
        self._velocities: dict[int, tuple[np.ndarray, float, float, bool]] = {}

    @abstractmethod
    def _make_core(self) -> Core: ...

    @abstractmethod
    def _message(self, found: Found) -> Sent: ...

    @abstractmethod
    def _queue(self) -> int:
        """Keyframes that came and were not taken up."""

    def _take(self, index: int, timestamp: float) -> None:
        """A keyframe is taken up."""
        self._came[index] = time.monotonic()
        self._core.pace.came(timestamp)

    def _overdue(self) -> list[Sent] | None:
        """Of a live stream the keyframe that has waited too long for later ones, if any: the camera may stand still."""
        oldest = self._core.waiting
        if not self.config.realtime or oldest is None or time.monotonic() - self._came[oldest] < PATIENCE:
            return None
        self.stats.count("keyframes that waited for no later ones")
        return list(self._messages(self._core.release()))

    def on_poses(self, poses: Poses) -> Iterator[Poses]:
        """Takes corrections in and passes them on, so that they reach the next stage between the same keyframes."""
        if not self._once.poses(poses):
            return
        segments = [None] * len(poses.index) if poses.segment is None else poses.segment.tolist()
        corrections = map(Correction, poses.world_from_cam, poses.scale.tolist(), segments)
        self._poses.update(zip(poses.index.tolist(), corrections, strict=True))
        if poses.exposure is not None:
            self._exposures.update(zip(map(int, poses.index), poses.exposure, strict=True))
        if poses.vignetting is not None:
            self._vignetting = poses.vignetting
        if poses.velocity is not None:
            for i, velocity, scale in zip(poses.index, poses.velocity, poses.scale, strict=True):
                if np.isfinite(velocity).all():
                    self._velocities[int(i)] = (velocity, float(scale), poses.readout_time, poses.reads_columns)
        self._core.move(self._poses)
        yield poses

    def on_tracked_frame(self, frame: TrackedFrame) -> Iterator[TrackedFrame]:
        """Passed on, in its place among the corrections: it needs no depth."""
        if self._once.frame(frame):
            yield frame

    def on_request(self, request: Request) -> Iterator[Sent | Request]:
        """Passed on, in its place: before a map is saved or closed, keyframes that wait for later ones go without."""
        if not self._once.request(request):
            return
        if not request.problem and request.asked in CLOSING:
            yield from self._messages(self._core.flush())
        if not request.problem and request.asked in (Asked.RESET, Asked.LOAD_MAP):
            self._core.forget()
            for known in (self._poses, self._exposures, self._velocities):
                known.clear()
            self._vignetting = None
        yield request

    def _exposed(self, message: Sent) -> Sent:
        """With exposure and vignetting as they are now: corrections may have overtaken the keyframe."""
        exposure = self._exposures.get(message.index, message.exposure)
        vignetting = message.vignetting if self._vignetting is None else self._vignetting
        return replace(message, exposure=exposure, vignetting=vignetting)

    def _moved(self, message: Keyframe | Depth, now: WindowedKeyframe) -> dict[str, Any]:
        """What corrections change of a message: pose, scale, segment and velocity, as its keyframe has them now.

        One that was sent before the rolling shutter was known is its own photograph.
        """
        as_sent = message.velocity, message.scale, message.readout_time, message.reads_columns
        velocity, scale, readout_time, reads_columns = self._velocities.get(message.index, as_sent)
        photograph = message.photograph
        if velocity is not None:
            velocity = geometry.twist_scaled(velocity, now.scale / scale)
            photograph = message.image if photograph is None else photograph
        return {
            "world_from_cam": now.world_from_cam, "scale": now.scale, "segment": now.segment,
            "photograph": photograph, "velocity": velocity, "readout_time": readout_time,
            "reads_columns": reads_columns,
        }  # fmt: skip

    def _corrected(self, keyframe: K) -> K:
        """With its newest correction, where that came before the keyframe."""
        return keyframe.moved(*self._poses[keyframe.index]) if keyframe.index in self._poses else keyframe

    def _messages(self, found: Iterator[Found]) -> Iterator[Sent]:
        """One message a result; the time is that of the core alone."""
        while True:
            with self.stats.time(self.step):
                one = next(found, None)
            if one is None:
                return
            sent = self._message(one)
            self._came.pop(sent.index, None)
            yield sent
