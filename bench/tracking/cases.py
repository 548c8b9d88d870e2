"""The sequences of the tracking benchmark: real videos, and the synthetic room with what makes tracking hard."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.runs import DATA
from bench.table import Row, skipped
from mvsgs_core.datasets import Item, open_dataset

NOISE = 1.5  # gray levels, of a sensor in the dark


@dataclass(frozen=True)
class Case:
    """`goal`: ATE of the keyframes, in centimeters, or as a fraction of the path where it ends with %."""

    reader: str
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: str = ""  # below ../shared/data
    goal: str = ""
    hard: bool = False  # what counts is that the loss is reported and nothing wrong goes out
    quick: bool = False
    baseline_stride: int = 2  # every nth frame is for COLMAP, and for us beside it; 0: none
    light: float = 1.0  # factor on the images; where it or haze is set, the noise of a sensor is added
    haze: float = 0.0  # gray levels that are added

    @property
    def path(self) -> Path | None:
        return DATA / self.folder if self.folder else None

    @property
    def there(self) -> bool:
        """Whether the data is on this machine."""
        return self.path is None or self.path.is_dir()

    def items(self) -> list[Item]:
        """The frames; raises FileNotFoundError where the data is not there."""
        options = dict(self.options)
        if self.path is not None:
            options["path"] = self.path
        items = list(open_dataset(self.reader, **options))
        clear = self.light == 1.0 and self.haze == 0.0
        return items if clear else [_dimmed(item, self.light, self.haze) for item in items]


def missing(cases: Mapping[str, Case]) -> list[Row]:
    """A row for each whose data is not on this machine: no table leaves one out in silence."""
    return [skipped(name, case.path) for name, case in cases.items() if case.path is not None and not case.there]


def _dimmed(item: Item, light: float, haze: float) -> Item:
    noise = np.random.default_rng(item.index).normal(haze, NOISE, item.image.shape)
    return replace(item, image=(light * item.image + noise).clip(0, 255).astype(np.uint8))


def _room(**options: Any) -> Mapping[str, Any]:
    return {"threads": 1, **options}


CASES: dict[str, Case] = {
    "tum_fr1_xyz": Case("tum", folder="tum_fr1_xyz", goal="1.1", quick=True, baseline_stride=1),
    "redkitchen": Case("seven_scenes", {"registered": False}, "seven_scenes_redkitchen", goal="4.5"),
    "redkitchen, color camera 525": Case("seven_scenes", {}, "seven_scenes_redkitchen", goal="4.5"),
    "redkitchen, a tenth of its light": Case(
        "seven_scenes", {"registered": False}, "seven_scenes_redkitchen", goal="4.5", light=0.1
    ),
    "redkitchen, a tenth of its contrast": Case(
        "seven_scenes", {"registered": False}, "seven_scenes_redkitchen", goal="4.5", light=0.1, haze=180.0
    ),
    "icl_nuim_of_kt0": Case("icl_nuim", folder="icl_nuim_of_kt0", baseline_stride=1),
    "kitti_piece": Case("tum", folder="kitti_piece", goal="0.15%", baseline_stride=1),
    "kitti_piece, every other frame": Case("tum", {"stride": 2}, "kitti_piece", goal="0.15%", baseline_stride=1),
    "hololens_000": Case("tum", folder="hololens_000", baseline_stride=1),
    "hololens_000, every other frame": Case("tum", {"stride": 2}, "hololens_000", baseline_stride=1),
    "room": Case("synthetic", _room(frames=120), goal="0.3%", quick=True),
    "room, loop": Case("synthetic", _room(frames=300, loop=True), goal="0.3%", baseline_stride=3),
    "room, motion blur": Case("synthetic", _room(frames=120, motion_blur=0.5)),
    "room, noise and exposure": Case("synthetic", _room(frames=120, noise=6.0, exposure=0.5)),
    "room, gloss": Case("synthetic", _room(frames=120, gloss=0.5)),
    "room, moving object": Case("synthetic", _room(frames=120, moving_object=1.5)),
    "room, bare walls": Case("synthetic", _room(frames=120, textureless=2)),
    "aerial": Case("synthetic", _room(frames=120, scene="aerial")),
    "tum_fr3_structure_notexture_far": Case("tum", folder="tum_fr3_structure_notexture_far", hard=True),
    "room, pure rotation first": Case("synthetic", _room(frames=150, pure_rotation=30), hard=True),
    "room, lens covered 30 frames": Case("synthetic", _room(frames=180, covered=30), hard=True),
    "room, jump of 100 frames": Case("synthetic", _room(frames=240, jump=100), hard=True),
    "room, half of the frames dropped": Case("synthetic", _room(frames=160, drop=0.5), hard=True),
}
