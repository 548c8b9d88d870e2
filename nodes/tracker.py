"""Frame -> Keyframe, Poses, Trajectory: the weight-free tracker (mvsgs_core.tracking)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import Frame, Keyframe, Poses
from mvsgs_core import geometry
from mvsgs_core.tracking import tracker as core
from mvsgs_core.tracking.back_end import BackEndConfig
from mvsgs_core.tracking.coarse_depth import coarse_map
from mvsgs_core.tracking.estimation.rolling_shutter import checked_readout_time, rectified
from mvsgs_core.tracking.front_end import FrontEndConfig
from mvsgs_core.tracking.initializer import InitializationConfig
from mvsgs_core.tracking.local_map import LocalMapConfig
from mvsgs_core.tracking.places.covisibility import CovisibilityConfig
from nodes.tracking import TrackerNode


class Tracker(TrackerNode):
    """Dense bundle adjustment over semi-dense matches; see mvsgs_core.tracking.tracker."""

    @dataclass
    class Config:
        area: int = 320 * 240  # pixels of the tracker's own image, aspect kept; at most twice enlarged
        flow: str = "lucas_kanade"  # lucas_kanade, dis, features, raft_small, or module:Class
        keyframe_flow: float = 0.05  # of the width: median flow that makes a keyframe
        keyframe_fraction: float = 0.5  # of the textured points: fewer found make a keyframe
        still_flow: float = 0.001  # of the width: median flow below which a frame is skipped
        start_keyframes: int = 6  # before a start is tried
        window: int = 12  # keyframes of the local bundle adjustment
        recent: int = 3  # keyframes before a new one that it is matched with
        proximity: int = 3  # older keyframes that it is matched with
        steps: int = 5  # of the local bundle adjustment
        global_edges: int = 6  # of each keyframe in the global bundle adjustment
        readout_time: float | None = (
            None  # seconds of the camera's rolling shutter, 0 for a global one; null: estimated
        )
        rectify_rolling_shutter: bool = True  # keyframes' images are sent as a global shutter would have taken them
        loops: bool = True  # old keyframes are looked for by appearance
        known_flow: float = 0.13  # of the width: no keyframe is made for a view this near to an old one; 0: always
        known_from: int = 64  # keyframes of a map: a smaller one takes every view
        tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not sent
        device: str = "cpu"  # of bundle adjustment: cpu (C++), cuda or cuda:0 (PyTorch), auto (CUDA if there is one)
        threads: int | None = None  # of the C++ kernels; null: 1

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c = self.config
        self._tracker = core.Tracker(
            core.TrackerConfig(
                area=c.area,
                flow=c.flow,
                tolerance=c.tolerance,
                threads=c.threads or 1,
                device=_device(c.device),
                front_end=FrontEndConfig(
                    still_flow=c.still_flow, keyframe_flow=c.keyframe_flow, keyframe_fraction=c.keyframe_fraction
                ),
                local_map=LocalMapConfig(window=c.window, recent=c.recent, proximity=c.proximity, steps=c.steps),
                back_end=BackEndConfig(edges=c.global_edges),
                initialization=InitializationConfig(keyframes=c.start_keyframes),
                readout_time=checked_readout_time(c.readout_time),
                loops=c.loops,
                covisibility=CovisibilityConfig(min_keyframes=c.known_from, max_flow=c.known_flow),
            )
        )

        self._readout_times: list[float] = []  # seconds of readout time that were taken out of each keyframe's image

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses]:
        self._frames[frame.index] = frame
        update = self._tracker.add(
            frame.index, frame.timestamp, frame.image, frame.intrinsics, frame.intrinsics_guessed
        )
        yield from self._send(update)

    @property
    def _core(self) -> core.Tracker:
        return self._tracker

    @property
    def _focal_factor(self) -> float:
        return self._tracker.focal_factor

    @property
    def _readout_time(self) -> float:
        return self._tracker.readout_time if self.config.rectify_rolling_shutter else 0.0

    def _keyframe(self, index: int) -> Keyframe:
        frame, keyframe = self._frames[index], self._tracker.keyframe(index)
        inverse_depth, weight = coarse_map(keyframe)
        with self.stats.time("rectification"):
            image = rectified(frame.image, keyframe.image, self._readout_time)
        self._readout_times.append(0.0 if keyframe.image.velocity is None else self._readout_time)
        if max(self._readout_times) > 0.0:
            self.stats.values["rolling shutter taken out of keyframes"] = spread(self._readout_times)
        if self._readout_time and keyframe.image.velocity is None:
            self.stats.count("keyframes with the rolling shutter still in: no velocity")
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=image,
            intrinsics=frame.intrinsics * [self._tracker.focal_factor, self._tracker.focal_factor, 1.0, 1.0],
            world_from_cam=geometry.inverse(keyframe.cam_from_world),
            scale=1.0,
            inverse_depth=inverse_depth,
            inverse_depth_weight=weight,
            segment=keyframe.segment,
        )


def spread(readouts: list[float]) -> str:
    """What was taken out of the keyframes, seconds: the estimate gets better while they go out."""
    low, mean, high = (1e3 * float(f(readouts)) for f in (np.min, np.mean, np.max))
    return f"{mean:.1f} ms" if high - low < 0.05 else f"{mean:.1f} ms in the mean, {low:.1f} to {high:.1f}"


def _device(name: str) -> str:
    if name != "auto":
        return name
    import torch  # takes a second to load, and the CPU does without

    return "cuda" if torch.cuda.is_available() else "cpu"
