"""Keyframe -> Depth: multi-view stereo with two keyframes of lag. Poses pass through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msgs import Depth, Keyframe
from mvsgs_core.mvs.cascade import Cascade, CascadeConfig, CascadeDepth, OnlineStereo
from mvsgs_core.pace import check_efforts
from nodes.windowed import WindowedNode


class StereoNode(WindowedNode[OnlineStereo, CascadeDepth, Depth]):
    """What every multi-view stereo does with messages; a subclass makes the stereo itself from its Config."""

    step = "stereo"

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._keyframes: dict[int, Keyframe] = {}  # without depth yet

    def on_keyframe(self, keyframe: Keyframe) -> Iterator[Depth]:
        if not self._once.keyframe(keyframe):
            return
        self._take(keyframe.index, keyframe.timestamp)
        passed_over = self.config.resume_after is not None and keyframe.index <= self.config.resume_after
        if passed_over:
            self.stats.skip("keyframes that the checkpoint has")
        else:
            self._keyframes[keyframe.index] = keyframe
        with self.stats.time("prepare"):
            view = self._core.prepare(
                keyframe.index,
                keyframe.image,
                intrinsics=keyframe.intrinsics,
                world_from_cam=keyframe.world_from_cam,
                inverse_depth=keyframe.inverse_depth,
                weight=keyframe.inverse_depth_weight,
                scale=keyframe.scale,
                segment=keyframe.segment,
                mask=keyframe.mask,
            )
        yield from self._messages(self._core.add(self._corrected(view), wanted=not passed_over))

    def on_idle(self) -> list[Depth] | None:
        return self._overdue()

    def on_end(self) -> Iterator[Depth]:
        yield from self._messages(self._core.flush())

    def _queue(self) -> int:
        return self.waiting(Keyframe)

    def _message(self, found: CascadeDepth) -> Depth:
        keyframe = self._keyframes.pop(found.view.index)
        self.stats.count("keyframes")
        if found.problem:
            self.stats.skip(f"keyframe: {found.problem}")
            self.stats.warn(f"some keyframes got no depth: {found.problem}")
        elif found.search is not None and found.search.source != "own grid":
            self.stats.count(f"range from {found.search.source}")
            self.stats.warn(f"some depth ranges come from the {found.search.source}: the tracker knew too little depth")
        self.stats.count("neighbors", len(found.neighbors))
        self.stats.count("hypotheses", found.result.counts.get("hypotheses", 0.0))
        for what in ("outside the range", "outside the cells"):
            self.stats.skip(f"hypotheses {what}", found.result.counts.get(what, 0.0))
        self.stats.values["mean confidence"] = float(np.mean(found.result.confidence))
        depth = depth_message(keyframe, found.result.depth, found.result.confidence)
        depth = replace(depth, **self._moved(depth, found.view), effort=found.effort)
        return self._exposed(depth)


def depth_message(keyframe: Keyframe, depth: np.ndarray, confidence: np.ndarray) -> Depth:
    """The keyframe with depth and confidence (H, W) in the place of its coarse inverse depth."""
    return Depth(
        index=keyframe.index,
        timestamp=keyframe.timestamp,
        image=keyframe.image,
        intrinsics=keyframe.intrinsics,
        world_from_cam=keyframe.world_from_cam,
        scale=keyframe.scale,
        depth=depth,
        confidence=confidence,
        segment=keyframe.segment,
        exposure=keyframe.exposure,
        vignetting=keyframe.vignetting,
        photograph=keyframe.photograph,
        velocity=keyframe.velocity,
        readout_time=keyframe.readout_time,
        reads_columns=keyframe.reads_columns,
        captured=keyframe.captured,
        stamp=keyframe.stamp,
        mask=keyframe.mask,
    )


class Mvs(StereoNode):
    """Plane-sweep cascade without weights; see mvsgs_core.mvs."""

    @dataclass(frozen=True)
    class Config(CascadeConfig):
        resume_after: int | None = None  # keyframes up to this frame are in a resumed map: neighbors of others only

    config: Config

    @classmethod
    def check(cls, config: Config) -> None:
        check_efforts(Cascade.efforts, config.efforts)

    def _make_core(self) -> Cascade:
        return Cascade(self.config)
