"""What can be set of the trackers, their parts' settings among it."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvsgs_core.setting_ranges import at_least, within
from mvsgs_core.tracking.back_end import BackEndConfig
from mvsgs_core.tracking.estimation.focal import FocalConfig
from mvsgs_core.tracking.estimation.rolling_shutter import check_readout_time
from mvsgs_core.tracking.front_end import FrontEndConfig
from mvsgs_core.tracking.initializer import InitializationConfig
from mvsgs_core.tracking.keyframe_choice import KeyframeChoiceConfig
from mvsgs_core.tracking.local_map import LocalMapConfig
from mvsgs_core.tracking.places.covisibility import CovisibilityConfig
from mvsgs_core.tracking.places.loop_closure import LoopConfig
from mvsgs_core.tracking.places.recovery import RecoveryConfig
from mvsgs_core.tracking.places.relocalization import RelocalizationConfig

LEAST_AREA = 32 * 32  # pixels: OpenCV's flow between frames takes no image of a few


@dataclass(frozen=True)
class KeyframeTrackingConfig:
    """What a tracker takes that follows the points of keyframes, whether it finds poses or is given them."""

    # pixels of the tracker's own image, aspect kept; doubled at most; more of one that is wider than 16:9
    area: int = 320 * 240
    flow: str = "lucas_kanade"  # lucas_kanade, dis, features, raft_small, or module:Class
    threads: int | None = None  # of the C++ kernels; null: 1
    min_texture: float = 0.05  # fraction of the cells that must be textured for an image to be of any use
    frames_between: int = 8  # frames between two keyframes, at most, that the map is trained on, too; 0: none
    keyframe_choice: KeyframeChoiceConfig = field(default_factory=KeyframeChoiceConfig)
    local_map: LocalMapConfig = field(default_factory=LocalMapConfig)

    def __post_init__(self) -> None:
        at_least(self, area=LEAST_AREA)
        within(self, min_texture=(0, 1))
        if self.frames_between < 0:
            raise ValueError(f"tracker.frames_between={self.frames_between}: a number of frames, 0 for none")


@dataclass(frozen=True)
class PosedConfig(KeyframeTrackingConfig):
    """Raises ValueError for what can't be a readout time, or a number of frames."""

    readout_time: float = 0.0  # seconds of the camera's rolling shutter, 0 for a global one: true poses don't tell it
    reads_columns: bool = False  # of a phone that is held upright: it reads columns within that time, not rows

    def __post_init__(self) -> None:
        super().__post_init__()
        check_readout_time(self.readout_time, self.reads_columns)


@dataclass(frozen=True)
class TrackerConfig(KeyframeTrackingConfig):
    """Raises ValueError for what can't be a readout time, a share or a number of frames."""

    readout_time: float | None = None  # seconds of the camera's rolling shutter, 0 for a global one; null: estimated
    reads_columns: bool = False  # where that is given, of a phone that is held upright: it reads columns, not rows
    loops: bool = True  # old keyframes are looked for by appearance
    realtime: bool = False  # keyframes are worked on as there is time, not before the next frame
    # of a core's time that the tracker may take in real time: beyond, keyframes are farther apart; null: half of all
    # cores', at most 0.9
    share: float | None = None
    tolerance: float = 0.002  # of depth, radians, scale: smaller corrections are not sent
    min_matches: int = 150  # of a pair of keyframes, median: fewer, and the map may be bent, which is warned of
    device: str = "cpu"  # of bundle adjustment: cpu (C++), cuda or cuda:0 (PyTorch), auto (CUDA if there is one)
    initialization: InitializationConfig = field(default_factory=InitializationConfig)
    front_end: FrontEndConfig = field(default_factory=FrontEndConfig)
    covisibility: CovisibilityConfig = field(default_factory=CovisibilityConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    focal: FocalConfig = field(default_factory=FocalConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, tolerance=0, min_matches=0)
        check_readout_time(self.readout_time, self.reads_columns)
        if self.share is not None and not 0.0 < self.share <= 1.0:
            raise ValueError(f"tracker.share={self.share}: of a core's time, above 0 and at most 1; null: half of all")


__all__ = ["PosedConfig", "TrackerConfig"]
