"""What can be set of DROID-SLAM: the constants of its 2021/22 generation, by preset, and what is set around them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Literal

Constant = int | float | tuple[int, ...]
CorrelationKind = Literal["volume", "on_the_fly"]  # fast, or of little memory


LEAST_SIDE = 64  # pixels of the image that the networks see: 8 cells, as the correlation pyramid halves three times
_LEAST: dict[str, int] = {  # where it is not 0
    "stride": 1,
    "warmup": 2,  # two keyframes make an edge
    "frontend_window": 1,
    "frontend_radius": 1,  # at 0 a keyframe would be joined to itself
    "max_factors": 1,
    "max_age": 1,
    "first_updates": 1,
    "backend_radius": 1,
    "backend_steps": 1,
}


@dataclass(frozen=True)
class Constants:
    """The defaults are those of the `demo` preset. All thresholds are in pixels of the 1/8 map.

    Raises ValueError for values that DROID-SLAM cannot run with.
    """

    stride: int = 3  # frames: every which one may become a keyframe
    filter_threshold: float = 2.4  # mean revision of the flow that lets a frame pass the motion filter
    warmup: int = 8  # keyframes before the start is solved
    beta: float = 0.3  # fraction of the full flow in the distance of two frames, the rest is of translation alone
    keyframe_threshold: float = 4.0  # distance below which a keyframe is dropped again
    frontend_threshold: float = 16.0  # largest distance of an edge by proximity
    frontend_window: int = 25  # keyframes back that edges may reach
    frontend_radius: int = 2  # keyframes back that are always linked, one more than this
    frontend_nms: int = 1  # suppression of edges beside a chosen one
    max_factors: int = 48  # edges of the frontend's graph
    max_age: int = 25  # updates after which an edge retires
    first_updates: int = 4  # of a new keyframe
    further_updates: int = 2  # once it is known that it stays
    backend_threshold: float = 22.0  # largest distance of an edge by proximity
    backend_radius: int = 2  # as frontend_radius
    backend_nms: int = 3  # as frontend_nms
    backend_steps: tuple[int, ...] = (7, 12)  # updates of each global bundle adjustment at the end
    backend_every: int = 0  # keyframes between global bundle adjustments on the way; 0: only at the end

    def __post_init__(self) -> None:
        for name, given in vars(self).items():
            least = _LEAST.get(name, 0)
            if not all(least <= value < math.inf for value in (given if isinstance(given, tuple) else (given,))):
                raise ValueError(f"constants.{name}={given}: must be {least} or more")
        if self.beta > 1:
            raise ValueError(f"constants.beta={self.beta}: is a fraction, 0 to 1")


PRESETS = {
    "demo": Constants(),
    "tum": Constants(
        stride=2,
        filter_threshold=1.75,
        warmup=12,
        beta=0.6,
        keyframe_threshold=2.25,
        frontend_threshold=12.0,
        backend_threshold=15.0,
    ),
    # as the GO-SLAM family runs Replica
    "replica": Constants(
        stride=1,
        filter_threshold=1.75,
        beta=0.6,
        keyframe_threshold=2.25,
        frontend_threshold=25.0,
        frontend_window=50,
        frontend_radius=1,
        max_factors=75,
        max_age=50,
        backend_threshold=25.0,
        backend_every=50,
    ),
}


@dataclass(frozen=True)
class DroidConfig:
    """Raises ValueError for constants that DROID-SLAM does not have or cannot run with, and for too small an area."""

    weights: str | None = None  # file; null: droid.pth in $MVSGS_WEIGHTS or the cache; random: noise, for a trial
    preset: Literal["demo", "tum", "replica"] = "demo"  # the setting that the constants were published for
    constants: dict[str, Constant] = field(default_factory=dict)  # instead of the preset's, as constants.stride=1
    area: int = 384 * 512  # pixels of the image that the networks see, aspect kept
    correlation: CorrelationKind = "volume"  # of the frontend: volume (fast) or on_the_fly (little memory)
    global_correlation: CorrelationKind = "volume"  # of the backend, which holds that of one edge at a time
    tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not sent
    device: str = "auto"  # auto (CUDA if there is one), cpu, cuda:0
    threads: int | None = None  # of the bundle adjustment; null: 1

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise ValueError(f"no preset {self.preset!r} of DROID-SLAM: give one of {', '.join(PRESETS)}")
        defaults = {f.name: f.default for f in fields(Constants)}
        for name, value in self.constants.items():
            if name not in defaults:
                raise ValueError(f"DROID-SLAM has no constant {name!r}; it has: {', '.join(defaults)}")
            kind = type(defaults[name])
            if type(value) is not kind and not (kind is float and type(value) is int):
                raise ValueError(f"constants.{name}={value}: must be of the kind of {defaults[name]}")
        _ = self.chosen  # raises for values out of range
        if self.area < LEAST_SIDE**2:
            raise ValueError(f"area={self.area}: must be {LEAST_SIDE**2} or more, for {LEAST_SIDE} pixels each way")

    @property
    def chosen(self) -> Constants:
        """The preset's constants, or those given instead."""
        return replace(PRESETS[self.preset], **self.constants)  # type: ignore[arg-type]


__all__ = ["LEAST_SIDE", "PRESETS", "Constants", "CorrelationKind", "DroidConfig"]
