"""What can be set of the tracker, its parts' settings among it."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvsgs_core.tracking.back_end import BackEndConfig
from mvsgs_core.tracking.estimation.focal import FocalConfig
from mvsgs_core.tracking.front_end import FrontEndConfig
from mvsgs_core.tracking.initializer import InitializationConfig
from mvsgs_core.tracking.local_map import LocalMapConfig
from mvsgs_core.tracking.places.covisibility import CovisibilityConfig
from mvsgs_core.tracking.places.loop_closure import LoopConfig
from mvsgs_core.tracking.places.recovery import RecoveryConfig
from mvsgs_core.tracking.places.relocalization import RelocalizationConfig


@dataclass(frozen=True)
class TrackerConfig:
    area: int = 320 * 240  # pixels of the tracker's image, same aspect as the input
    flow: str = "lucas_kanade"  # mvsgs_core.tracking.matching.flow.FLOWS, or module:Class
    tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not told
    loops: bool = True  # look for old keyframes by appearance
    readout_time: float | None = None  # seconds of a rolling shutter, 0 for a global one; None: estimated
    texture: float = 0.05  # fraction of the cells that must be textured for an image to be of any use
    matches: int = 150  # of a pair of keyframes, median: fewer, and the map may be bent, which is told
    threads: int = 1
    device: str = "cpu"  # of the local and global bundle adjustment, see Solver; single frames stay on the CPU
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)
    focal: FocalConfig = field(default_factory=FocalConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)
    covisibility: CovisibilityConfig = field(default_factory=CovisibilityConfig)


__all__ = ["TrackerConfig"]
