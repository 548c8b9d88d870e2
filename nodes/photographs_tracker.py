"""Frame -> Keyframe, TrackerPhase, Trajectory: photographs in any order, with wide steps (mvsgs_core.photographs)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from msgs import Frame, Keyframe
from mvsgs_core.datasets.lens import Lens, Undistortion
from mvsgs_core.export.source_camera import PHOTOGRAPHS
from mvsgs_core.photographs.config import PhotographsConfig
from mvsgs_core.photographs.tracker import PhotographTracker
from mvsgs_core.tracking.publish import Update
from nodes.tracking import TrackerNode

KEPT = 4  # lenses whose maps are kept: each photograph may have another, and a map takes as much as its image
VISIBLE = 1.0  # pixels by which a distortion must bend the corner of an image to be taken out of it
AS_IT_CAME = (1.0, 0.0, 0.0)  # a lens: factor on its focal lengths, k1 and k2


class PhotographsTracker(TrackerNode):
    """Structure from motion of a set of photographs; everything leaves when the last one has come."""

    in_stream_order: ClassVar[bool] = False
    one_camera: ClassVar[bool] = False

    @dataclass(frozen=True)
    class Config(PhotographsConfig):
        pass

    config: Config
    core: PhotographTracker

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self.core = PhotographTracker(self.config)
        self._bent = False  # a keyframe of the largest part
        self._lenses: dict[tuple[float, ...], Undistortion] = {}  # the newest, by intrinsics, k1, k2, height and width
        self._said: set[tuple[float, float, float]] = set()  # lenses whose distortion was told

    def _add(self, frame: Frame) -> Update:
        guessed, place = frame.intrinsics_guessed, self._places.get(frame.index)
        return self.core.add(
            frame.index, frame.timestamp, frame.image, frame.intrinsics, guessed, frame.exposure, place, frame.mask
        )

    @property
    def _focal_factor(self) -> float:
        return self.core.lens[0]

    @property
    def _distortion(self) -> np.ndarray | None:
        return np.array(self.core.lens[1:]) if self._bent else None

    def _keyframe(self, index: int) -> Keyframe:
        frame = self._frames[index]
        lens = self._undistortion(frame)
        with self.stats.time("undistortion"):
            image = lens.image(frame.image)
        found = self.core.keyframe(index, lens.intrinsics, frame.image.shape[:2])
        return Keyframe(
            index=index,
            timestamp=frame.timestamp,
            image=image,
            intrinsics=lens.intrinsics,
            world_from_cam=found.world_from_cam,
            scale=1.0,
            inverse_depth=found.inverse_depth,
            inverse_depth_weight=found.weight,
            segment=found.segment,
            exposure=self.core.exposure(index),
            vignetting=self.core.light.vignetting,
            mask=None if frame.mask is None else lens.mask(frame.mask),
        )

    def _report(self) -> None:
        super()._report()
        factor, k1, k2 = self.core.lens
        if (factor, k1, k2) != AS_IT_CAME:
            self.stats.values[PHOTOGRAPHS] = [factor, k1, k2] if self._bent else [factor, 0.0, 0.0]

    def _undistortion(self, frame: Frame) -> Undistortion:
        """Of the lens that was estimated in its part, for images such as this; none where nobody would see it."""
        factor, k1, k2 = self.core.keyframe_lens(frame.index)
        fx, fy, cx, cy = (float(v) for v in frame.intrinsics * [factor, factor, 1.0, 1.0])
        size = (frame.image.shape[0], frame.image.shape[1])
        key = (fx, fy, cx, cy, k1, k2, *size)
        if key not in self._lenses:
            r2 = (max(cx, size[1] - cx) / fx) ** 2 + (max(cy, size[0] - cy) / fy) ** 2
            bent = abs(r2 * (k1 + r2 * k2)) * r2**0.5 * fx
            if len(self._lenses) == KEPT:
                del self._lenses[next(iter(self._lenses))]
            self._lenses[key] = Undistortion(Lens((fx, fy, cx, cy), size, (k1, k2, 0.0, 0.0) if bent > VISIBLE else ()))
            if bent > VISIBLE and (factor, k1, k2) not in self._said:
                self._said.add((factor, k1, k2))
                self._bent |= (factor, k1, k2) == self.core.lens
                came = frame.intrinsics if frame.original_intrinsics is None else frame.original_intrinsics
                camera = ",".join(f"{v:.2f}" for v in came * [factor, factor, 1.0, 1.0])
                self.stats.warn(
                    f"the photographs are distorted, by up to {bent:.0f} pixels, which is taken out: "
                    f"dataset.intrinsics=[{camera}] dataset.distortion=[{k1:.5f},{k2:.5f},0,0] does it before"
                )
        return self._lenses[key]
