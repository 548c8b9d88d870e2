"""DROID-SLAM as a tracker: images in; keyframes, corrected poses and the whole trajectory out.

What is done with a frame depends on the frames before it alone: the same stream always gives the same poses on a CPU.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from mvsgs_core import geometry
from mvsgs_core.devices import torch_device
from mvsgs_core.droid.backend import FACTORS_PER_KEYFRAME, adjust_globally
from mvsgs_core.droid.confidence import Coarse, coarse_map, consistent_fraction
from mvsgs_core.droid.config import DroidConfig
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.framing import Framing
from mvsgs_core.droid.frontend import MIN_KEYFRAMES, Frontend
from mvsgs_core.droid.motion_filter import Encoded, MotionFilter
from mvsgs_core.droid.networks import RANDOM, Networks, load
from mvsgs_core.droid.trajectory_filler import StoredFrame, fill
from mvsgs_core.droid.video import Video, VideoFrame
from mvsgs_core.frame_store import FrameStore
from mvsgs_core.held_out import is_held_out
from mvsgs_core.networks.droid import DroidNet
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.keyframe_choice import HELD_OUT
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Publisher, Update
from mvsgs_core.trajectory import TrackingState, Trajectory

_DEGENERATE = 0.05  # fraction of cells that agree with a neighbor, below which a keyframe's depth is none
_MANY = 512  # keyframes beyond which is said what they cost: the buffer of the published system
_EDGE = 128  # bytes a cell that an edge of the global graph takes beside its hidden state, about


class DroidSlam:
    def __init__(self, config: DroidConfig | None = None, net: DroidNet | None = None) -> None:
        """Raises FileNotFoundError or ValueError where the weights are missing or wrong. net: instead of weights."""
        self.config = config or DroidConfig()
        self.constants = self.config.chosen
        self.threads = self.config.threads or 1
        device = torch.device(torch_device(self.config.device))
        self.networks = Networks(load(self.config.weights) if net is None else net, device)
        self.stats = Stats()
        if net is None and self.config.weights == RANDOM:
            self.stats.warn("DROID-SLAM runs on random weights: its poses and depths are noise")
        self.framing: Framing | None = None
        self.frames: list[StoredFrame] = []
        self._store = FrameStore()  # of their images, until the end
        self._states: list[TrackingState] = []
        self.nothing = "no frame came"  # why there is no pose at all, after `finish`; empty where there is one
        self._trajectory = Trajectory.empty()

    def add(self, index: int, timestamp: float, image: np.ndarray, intrinsics: np.ndarray) -> Update:
        """The next frame: (H, W, 3) uint8 RGB with its intrinsics (4,); indices must grow."""
        if self.framing is None:
            self._set_up(image.shape[0], image.shape[1], intrinsics)
        assert self.framing is not None
        cells = self.framing.intrinsics(intrinsics, (image.shape[0], image.shape[1]))
        if not np.allclose(cells, self.video.intrinsics, rtol=1e-3):
            self.stats.warn("the intrinsics change between frames: the tracker goes on with those of the first")
        with self.stats.time("image"):
            small = self.framing.image(image)
            self._keep(StoredFrame(index, timestamp, self._store), small)
        self.stats.count("frames")
        self._states.append(TrackingState.TRACKED if self.frontend.started else TrackingState.NOT_INITIALIZED)
        if (len(self.frames) - 1) % self.constants.stride:
            self.stats.skip("frames between strides")
            return Update(self._states[-1])
        with self.stats.time("motion filter"):
            encoded = self.motion_filter.passes(small)
        if encoded is None:
            self.stats.skip("frames that moved too little")
            return Update(self._states[-1])
        pose, inverse_depth = self.frontend.start_values()
        self.video.append(VideoFrame(index, timestamp, pose, np.full(self.framing.grid, inverse_depth), *encoded))
        if len(self.video) > _MANY:
            self.stats.warn(_told_memory(encoded))
        kept = self.frontend.advance()
        every = self.constants.backend_every
        if kept and every and self.frontend.started and len(self.video) % every == 0:
            self._adjust_globally(self.constants.backend_steps[-1:])
        return self._publish(self.frontend.settled)

    @property
    def phase(self) -> Phase:
        """What the tracker is doing."""
        return Phase.TRACKING if self.framing is not None and self.frontend.started else Phase.INITIALIZING

    @property
    def pending(self) -> set[int]:
        """Frames that may still become keyframes that are published: their images are needed until then."""
        return set() if self.framing is None else set(self.video.keyframes) - self.publisher.published

    def finish(self) -> Iterator[Update]:
        """The stream has ended: a start by force if there was none, then the global bundle adjustment."""
        if self.framing is None:
            return
        if not self.frontend.started and self.frontend.force_start():
            self.stats.warn("the start was forced at the end of the stream, on fewer keyframes than the warm-up takes")
        if not self.frontend.started:
            self.nothing = f"tracking never started: {self._why_not_started()}"
            self.stats.warn(self.nothing)
            self._trajectory = self._collect({})
            self._store.close()
            yield Update(TrackingState.NOT_INITIALIZED)
            return
        self.nothing = ""
        yield self._publish(len(self.video))
        self._adjust_globally(self.constants.backend_steps)
        self._trajectory = self._collect(self._fill())
        self.stats.count(HELD_OUT, sum(is_held_out(index) for index in self.video.keyframes))
        if self.networks.not_finite:
            self.stats.warn(f"{self.networks.not_finite} network outputs were not finite and were ignored")
        self._store.close()
        yield Update(TrackingState.TRACKED, (), self.publisher.corrections(True))

    def trajectory(self) -> Trajectory:
        """Every frame's pose, after `finish`."""
        return self._trajectory

    def keyframe(self, index: int) -> VideoFrame:
        return self.video.keyframes[index]

    def coarse_map(self, index: int) -> Coarse:
        """Inverse depth and confidence of a keyframe, for the whole view of its image."""
        assert self.framing is not None
        position = [frame.index for frame in self.video.frames].index(index)
        return coarse_map(self.video, self.graph, position, self.framing)

    def _keep(self, frame: StoredFrame, image: np.ndarray) -> None:
        """A disk that is full costs poses of frames between keyframes, not the run."""
        self.frames.append(frame)
        try:
            frame.put(image)
        except OSError as error:
            self.stats.refuse(
                "frames", 1, f"frames that the disk of TMPDIR had no room for get no pose ({error.strerror or error})"
            )

    def _why_not_started(self) -> str:
        count, stride = len(self.frames), self.constants.stride
        tried = len(range(0, count, stride))
        of = f"{tried} frames" + (f" (of {count}, stride={stride})" if stride > 1 else "")
        if tried < MIN_KEYFRAMES:
            return f"too few frames: {of} may become keyframes, of which a start takes {MIN_KEYFRAMES}"
        wrong = self.networks.not_finite
        return (f"{wrong} network outputs were not finite, which is taken for no motion; " if wrong else "") + (
            f"too little motion: {len(self.video)} of {of} moved by {self.constants.filter_threshold:g} cells or more "
            f"(filter_threshold) since the one before, of which a start takes {MIN_KEYFRAMES}"
        )

    def _set_up(self, height: int, width: int, intrinsics: np.ndarray) -> None:
        config = self.config
        self.framing = Framing.of(height, width, config.area)
        self.video = Video(self.framing.intrinsics(intrinsics))
        self.graph = FactorGraph(
            self.video,
            self.networks,
            correlation=config.correlation,
            max_factors=self.constants.max_factors,
            threads=self.threads,
        )
        self.motion_filter = MotionFilter(self.networks, self.constants.filter_threshold)
        self.frontend = Frontend(self.video, self.graph, self.constants, self.stats)
        self.publisher = Publisher(self.video, config.tolerance)

    def _publish(self, settled: int) -> Update:
        """Keyframes that have become settled, after corrections of those before."""
        correction, published = self.publisher.corrections(), self.publisher.published
        new = [frame for frame in self.video.frames[:settled] if frame.index not in published]
        for frame in new:
            self.publisher.publish(frame.index)
        self.stats.count("keyframes", len(new))
        if self.frontend.started:
            position = max(0, len(self.video) - 2)
            flat = consistent_fraction(self.video, position) < _DEGENERATE
            self._states[-1] = TrackingState.DEGENERATE if flat else TrackingState.TRACKED
            if flat:
                self.stats.warn("keyframes whose depth agrees with no other: their poses mean little")
        return Update(self._states[-1], tuple(frame.index for frame in new), correction)

    def _adjust_globally(self, steps: tuple[int, ...]) -> None:
        with self.stats.time("global bundle adjustment"):
            for count in steps:
                kind = self.config.global_correlation
                adjust_globally(self.video, self.networks, self.constants, count, kind, self.threads, self.stats)

    def _fill(self) -> dict[int, np.ndarray]:
        """cam_from_world of every frame whose image is there."""
        own = self.video.keyframes
        others = [frame for frame in self.frames if frame.index not in own and frame.is_there]
        with self.stats.time("frames between keyframes"):
            found = fill(self.video, self.networks, others, self.config.correlation, self.threads, self.stats)
        poses = {frame.index: pose for frame, pose in zip(others, found)}
        return poses | {index: frame.cam_from_world for index, frame in own.items()}

    def _collect(self, cam_from_world: dict[int, np.ndarray]) -> Trajectory:
        """By frame: of all of them, or of none where there was no start."""
        poses, states = np.full((len(self.frames), 4, 4), np.nan), np.array(self._states, np.uint8)
        keyframes: Mapping[int, VideoFrame] = {}
        if cam_from_world:
            keyframes = self.video.keyframes
            missing = np.full((4, 4), np.nan)
            poses = geometry.inverse(np.stack([cam_from_world.get(frame.index, missing) for frame in self.frames]))
            states[states == TrackingState.NOT_INITIALIZED] = TrackingState.TRACKED
            unknown = ~np.isfinite(poses).all(axis=(1, 2))
            poses[unknown], states[unknown] = np.nan, TrackingState.LOST
        return Trajectory(
            index=np.array([frame.index for frame in self.frames], np.int64),
            timestamp=np.array([frame.timestamp for frame in self.frames], np.float64),
            world_from_cam=poses,
            keyframe=np.array([frame.index in keyframes for frame in self.frames], bool),
            state=states,
            segment=np.where(np.isnan(poses[:, 0, 0]), -1, 0).astype(np.int32),
        )


def _told_memory(keyframe: Encoded) -> str:
    each = sum(tensor.nbytes for tensor in keyframe)
    edge = keyframe.hidden.nbytes + _EDGE * keyframe.hidden[0].numel()
    return (
        f"more than {_MANY} keyframes: DROID-SLAM keeps {each / 1e6:.1f} MB of each in memory, and the global bundle "
        f"adjustment takes up to {FACTORS_PER_KEYFRAME * edge / 1e6:.0f} MB each besides; fewer are kept with a larger "
        "constants.keyframe_threshold, and tracker=dense has a bound"
    )


__all__ = ["DroidSlam"]
