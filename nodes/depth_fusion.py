"""Depth -> FusedKeyframe: depth maps refined by their neighbors' and filtered, with two keyframes of lag."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from msgs import Depth, FusedKeyframe
from mvsgs_core import camera
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig, OnlineFusion
from mvsgs_core.fusion.keyframe_depth import KeyframeDepth
from nodes.windowed import WindowedNode


class FusionNode(WindowedNode[OnlineFusion, FusedDepth, FusedKeyframe]):
    """What every fusion of depth maps does with messages; a subclass makes the fusion itself from its Config."""

    step = "fusion"

    @classmethod
    def check(cls, config: Any) -> None:
        if config.min_views < 1:
            raise ValueError(f"min_views={config.min_views}: views that must agree, the reference counted: 1 or more")

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._depths: dict[int, Depth] = {}  # not sent yet

    def on_depth(self, depth: Depth) -> Iterator[FusedKeyframe]:
        if not self._once.keyframe(depth):
            return
        self._take(depth.index, depth.timestamp)
        self._depths[depth.index] = depth
        finite = np.isfinite(depth.depth) & np.isfinite(depth.confidence)
        if wrong := int((~finite).sum()):
            self.stats.refuse("pixels", wrong, "pixels whose depth or confidence is not finite have none in the map")
        view = KeyframeDepth(
            index=depth.index,
            depth=np.where(finite, depth.depth, np.float32(0)),
            confidence=np.where(finite, depth.confidence, np.float32(0)),
            intrinsics=camera.scale_intrinsics(depth.intrinsics, depth.image.shape[:2], depth.depth.shape),
            world_from_cam=depth.world_from_cam,
            scale=depth.scale,
            segment=depth.segment,
            mask=camera.mask_at(depth.mask, depth.depth.shape),
        )
        yield from self._messages(self._core.add(self._corrected(view)))

    def on_idle(self) -> list[FusedKeyframe] | None:
        return self._overdue()

    def on_end(self) -> Iterator[FusedKeyframe]:
        yield from self._messages(self._core.flush())
        if self.stats.counts.get("keyframes") and not self.stats.counts["pixels kept"]:
            self.stats.nothing(self._why_nothing())

    def _why_nothing(self) -> str:
        counts = self.stats.counts
        keyframes, filtered = f"{int(counts['keyframes'])} keyframes", counts["pixels with depth"]
        if not filtered:
            return f"none of {keyframes} has a pixel with stereo depth"
        start = "pixels rejected: "
        rejected = {name.removeprefix(start): n for name, n in counts.items() if name.startswith(start) and n}
        fractions = [
            f"{name} {100 * n / filtered:.0f} %" for name, n in sorted(rejected.items(), key=lambda item: -item[1])
        ]
        return (
            f"all depth of {keyframes} was rejected, by these filters, of the pixels with stereo depth, "
            f"their own or neighbors': {', '.join(fractions)} (a pixel can fail more than one)"
        )

    def _queue(self) -> int:
        return self.waiting(Depth)

    def _message(self, found: FusedDepth) -> FusedKeyframe:
        message = self._depths.pop(found.view.index)
        self.stats.count("keyframes")
        for name, value in found.counts.items():
            self.stats.count(f"pixels {name}" if name != "pixels" else name, value)
        if found.problem:
            self.stats.warn(f"some keyframes: {found.problem}")
            self.stats.count(found.problem)
        self.stats.values["part kept"] = found.counts["kept"] / found.counts["pixels"]
        fused = FusedKeyframe(
            index=message.index,
            timestamp=message.timestamp,
            image=message.image,
            intrinsics=message.intrinsics,
            **self._moved(message, found.view),
            depth=found.depth,
            confidence=found.confidence,
            normals=found.normals,
            unfiltered=found.unfiltered,
            exposure=message.exposure,
            vignetting=message.vignetting,
            captured=message.captured,
            stamp=message.stamp,
            mask=message.mask,
            effort=message.effort,
            fusion_effort=found.effort,
        )
        return self._exposed(fused)


class DepthFusion(FusionNode):
    """Geometric consistency and temporal refinement; see mvsgs_core.fusion."""

    @dataclass(frozen=True)
    class Config(FusionConfig):
        pass

    config: Config

    def _make_core(self) -> OnlineFusion:
        return OnlineFusion(self.config)
