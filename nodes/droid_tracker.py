"""Frame -> Keyframe, Poses, Trajectory: DROID-SLAM (mvsgs_core.droid); needs its published weights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch

from msgs import Frame, Keyframe, Poses
from mvsgs_core import geometry
from mvsgs_core.droid.presets import preset
from mvsgs_core.droid.system import DroidConfig, DroidSlam
from nodes.tracking import TrackerNode


class DroidTracker(TrackerNode):
    """Learned tracking as published in 2021; see mvsgs_core.droid. The preset's values hold where null is given."""

    @dataclass
    class Config:
        weights: str | None = None  # file; null: droid.pth in $MVSGS_WEIGHTS or the cache; random: noise, for a trial
        preset: str = "demo"  # demo, tum, replica: the published constants
        area: int = 384 * 512  # pixels of the image that the networks see, aspect kept
        stride: int | None = None  # every which frame may become a keyframe
        filter_threshold: float | None = None  # 1/8 pixels of motion that make a candidate
        keyframe_threshold: float | None = None  # 1/8 pixels below which a keyframe is dropped again
        warmup: int | None = None  # keyframes before the start
        window: int | None = None  # keyframes back that edges may reach
        backend_every: int | None = None  # keyframes between global bundle adjustments; 0: only at the end
        correlation: str = "volume"  # of the frontend: volume (fast) or on_the_fly (little memory)
        global_correlation: str | None = None  # of the backend; null: on_the_fly on a GPU, volume on the CPU
        tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not sent
        device: str = "auto"  # auto (CUDA if there is one), cpu, cuda:0
        threads: int | None = None  # of the bundle adjustment; null: 1

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        c = self.config
        device = c.device
        if device == "auto":
            device = "cuda:0" if torch.cuda.is_available() else "cpu"
        chosen: dict[str, Any] = {
            "stride": c.stride,
            "filter_threshold": c.filter_threshold,
            "keyframe_threshold": c.keyframe_threshold,
            "warmup": c.warmup,
            "frontend_window": c.window,
            "backend_every": c.backend_every,
        }
        self._tracker = DroidSlam(
            DroidConfig(
                preset=replace(preset(c.preset), **{k: v for k, v in chosen.items() if v is not None}),
                weights=c.weights,
                area=c.area,
                correlation=c.correlation,
                global_correlation=c.global_correlation or ("volume" if device == "cpu" else "on_the_fly"),
                tolerance=c.tolerance,
                device=device,
                threads=c.threads or 1,
            )
        )
        self._report()

    def on_frame(self, frame: Frame) -> Iterator[Keyframe | Poses]:
        self._frames[frame.index] = frame
        if frame.intrinsics_guessed:
            self.stats.warn(
                "the focal length is a guess, which this tracker takes for true: tracker=dense estimates it"
            )
        yield from self._send(self._tracker.add(frame.index, frame.timestamp, frame.image, frame.intrinsics))

    @property
    def _core(self) -> DroidSlam:
        return self._tracker

    def _keyframe(self, index: int) -> Keyframe:
        frame, coarse = self._frames[index], self._tracker.coarse_map(index)
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=frame.image,
            intrinsics=frame.intrinsics,
            world_from_cam=geometry.inverse(self._tracker.keyframe(index).cam_from_world),
            scale=1.0,
            inverse_depth=coarse.inverse_depth,
            inverse_depth_weight=coarse.weight,
            segment=0,
        )
