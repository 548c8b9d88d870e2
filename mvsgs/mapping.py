"""The whole system within a program: frames in; poses, renders and a map out. No process, no socket, no files.

    from mvsgs import Mapping

    with Mapping("mapper.iterations=100", intrinsics=[610, 610, 320, 240]) as mapping:
        for image, timestamp in frames:          # (H, W, 3) uint8 RGB, seconds
            tracked = mapping.add(image, timestamp)
            print(tracked.phase, tracked.world_from_cam)
    view = mapping.render(mapping.trajectory.world_from_cam[-1])
    mapping.save("runs/kitchen")                 # for `mvsgs view`, `info`, `export` and Mapping.load
    mapping.export("kitchen.glb")

The nodes of a run are at work, one message at a time (launch/inline.py), so that the same frames give the same map as
`mvsgs` does with `inline=true dataset.hide_fixed=false`: what is fixed to the camera is not looked for. Every fifth
frame after the first (`mvsgs_core.held_out`) is tracked and not mapped, as in every run.
"""

# ruff: noqa: E402
from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, from_numpy

from mvsgs.rooms import open_workspace

open_workspace()

from launch.compose import compose, parse
from launch.inline import InlineGraph
from launch.named_input import quoted
from msgs import CameraPose, FusedKeyframe, Keyframe, Poses, Preview, TrackerPhase
from msgs import Trajectory as TrajectoryMessage
from mvsgs.fed import Fed
from mvsgs.frames import Frames, Numbers
from mvsgs.gaussian_map import CAMERAS, GaussianMap, View
from mvsgs.saving import images_before, save_map
from mvsgs_core.datasets.framing import Size
from mvsgs_core.export.source_camera import LENS, lens_values, source_camera
from mvsgs_core.kept_map import check_kept_map
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.results import cameras_of
from mvsgs_core.mapping.losses import LossFunction, name_of
from mvsgs_core.mapping.resting_images import on_disk
from mvsgs_core.trajectory import Trajectory
from nodes import Node
from nodes.frozen_mapper import FrozenMapper
from nodes.mapper import Mapper
from nodes.runtime.runner import stats_of
from nodes.tracker import Tracker

SLOTS = ("tracker", "mvs", "depth_fusion", "mapper", "viewer")  # that a program may set; frames and results are its own
SETTINGS = ("device", "seed")
FIXED = (f"dataset._target_={Fed.__module__}.{Fed.__qualname__}", "evaluator=off")
_COMPOSING = threading.Lock()  # Hydra has one configuration at a time


@dataclass(frozen=True)
class PosedKeyframe:
    """A frame that the map is made of, where it stands now. Poses of two segments share no frame of reference."""

    index: int
    timestamp: float  # seconds
    world_from_cam: np.ndarray  # (4, 4) float64
    segment: int


@dataclass(frozen=True)
class Tracked:
    """What became of a frame at once."""

    index: int  # of the stream, from 0
    phase: str  # of the tracker from here on: initializing, tracking, relocalizing or lost
    world_from_cam: np.ndarray | None = None  # (4, 4) float64, before later corrections; None: it is not known yet
    confidence: float = 0.0  # of the map's points that this pose lets a keyframe show, the fraction that was seen
    keyframes: tuple[int, ...] = field(default=())  # frames, this one or earlier ones, that became keyframes now


class Mapping:
    """Frames of one moving camera -> poses of them all and a map of splats.

    `add` each frame, `finish` once (leaving the `with` block does), and at any time `render`, `save`, `export`. `add`
    returns when all that the frame brings is done: a moment mostly, a second or more where it became a keyframe, and
    `mapper.iterations` says how long. Where the camera must not wait, give the newest frame (examples/camera_loop.py),
    or use the graph of processes, which keeps pace by itself (`mvsgs camera`, `mvsgs tcp://robot:5555`).

    Threads: all methods may be called from any thread; each call waits for the one before. Several of these objects
    share nothing and may work at the same time.

    Failing: what is refused of a frame raises TypeError or ValueError and changes nothing. An exception out of the
    nodes' work, or Ctrl-C in its midst, ends the stream: the map so far can be rendered and saved, `add` and `finish`
    raise RuntimeError.
    """

    def __init__(
        self, *settings: str, intrinsics: Numbers | None = None, distortion: Numbers = (), fisheye: bool = False,
        size: Size = None, poses: bool = False, loss: LossFunction | None = None, map: str | Path | None = None,
    ) -> None:  # fmt: skip
        """The stream's camera, and what is done with it.

        - `settings`: as on the command line, of tracker, mvs, depth_fusion, mapper, viewer, device and seed:
          "tracker=droid", "mapper.iterations=300", "viewer=viser".
        - `intrinsics`: (fx, fy, cx, cy) in pixels of the frames as they are given; None: with the first frame, or else
          estimated, for which the first keyframes wait.
        - `distortion`, `fisheye`: OpenCV's coefficients of that camera.
        - `size`: (height, width), or a number of pixels, that is mapped; None: as the frames are, up to 1.5 million.
        - `poses`: each frame comes with its pose, nothing is tracked.
        - `loss`: what the mapper minimizes in place of its own, see mvsgs_core/mapping/losses.py.
        - `map`: output of a run with keep_map=true, or of `save`, that is gone on with.

        Raises TypeError or ValueError for settings that are none, with those there are, and for intrinsics that no
        camera has; OSError for weights that are missing.
        """
        self._lock = threading.RLock()
        self._frames = Frames(intrinsics, distortion, fisheye, size, poses)
        self._loaded = None if map is None else Path(map).expanduser().absolute()
        words = [*FIXED, *(["tracker=ground_truth"] if poses else []), *(["keep_map=true"] if map is not None else [])]
        words += [] if self._loaded is None else [f"map={quoted(str(self._loaded))}"]
        words += [] if loss is None else [f"mapper.training.loss_function={quoted(name_of(loss))}"]
        for word in settings:
            _check_setting(word)
        with _COMPOSING:
            graph = compose([*words, *settings])
        for slot in graph.slots.values():
            if "output" in slot.config:
                slot.config["output"] = None  # nothing is written but by `save`
            if slot.node is not Fed:
                slot.node.check(slot.parameters)
        self._graph = InlineGraph(graph, self._observe)
        nodes = self._graph.nodes
        source, mapper = nodes["dataset"], nodes.get("mapper")
        if not isinstance(mapper, Mapper | FrozenMapper):
            raise ValueError("mapper: its choices are ges, paper and frozen, or a subclass of nodes.mapper.Mapper")
        assert isinstance(source, Fed)
        self._source, self._mapper = source, mapper
        if "viewer" not in nodes:
            mapper.unread = frozenset({Preview})
        self._phase = "initializing"
        self._pose: CameraPose | None = None  # of the frame that is at work
        self._new: list[int] = []  # keyframes that it brought
        self._keyframes: dict[int, PosedKeyframe] = {}
        self._came: dict[int, Tensor] = {}  # images of keyframes that are trained on another one
        if self._loaded is not None and isinstance(mapper, Mapper):
            self._came = images_before(self._loaded, self._atlas)
        self._trajectory: Trajectory | None = None  # once the stream is over
        self._map: GaussianMap | None = None  # as it is now, where somebody has asked for it
        self._over = ""  # why no frame is taken any more

    @classmethod
    def load(cls, folder: str | Path, *settings: str, **camera: Any) -> Mapping:
        """Goes on with a map that `save`, or a run with keep_map=true, left: the tracker looks for the camera in it.

        settings, camera: as in the constructor; mapper=frozen only localizes. Its frames are numbered from 0 again.
        Raises ValueError where the folder has no such map; `GaussianMap.load` opens any, to look at.
        """
        check_kept_map(Path(folder).expanduser())
        return cls(*settings, map=folder, **camera)

    def __enter__(self) -> Mapping:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        """Finishes the map, unless the block was left by an exception."""
        if kind is None:
            self.finish()
        else:
            self._end_early(f"{kind.__name__}: {error}")

    def add(
        self, image: np.ndarray, timestamp: float, *, intrinsics: Numbers | None = None, pose: np.ndarray | None = None,
        mask: np.ndarray | None = None,
    ) -> Tracked:  # fmt: skip
        """The next frame: (H, W, 3) uint8 RGB, of which a copy is made, and its time in seconds, which only grows.

        intrinsics: as in the constructor, for a stream that brings them. pose: (4, 4) world_from_cam, x right, y down,
        z forward, if and only if the Mapping was made with poses=True. mask: (H, W) bool or uint8, 0 where a pixel is
        no part of the scene, as a person's or the robot's own: it is neither tracked nor mapped.
        Raises TypeError or ValueError, and nothing has changed then, for an image of another kind, or of another size
        than the first, time that goes back or stands still, a pose, intrinsics or a mask that are none; RuntimeError
        after the end of the stream.
        """
        with self._lock:
            self._check_open()
            frame, truth = self._frames.accept(image, timestamp, intrinsics, pose, mask)
            if frame.index == 0:
                assert self._frames.lens is not None
                self._source.stats.values[LENS] = lens_values(self._frames.lens)
                for notice in self._frames.notices:
                    self._source.stats.warn(notice)
            self._source.stats.count("frames")
            self._source.frames += (frame, truth)
            self._pose, self._new = None, []
            with self._at_work():
                self._graph.run_sources()
            known = self._pose
            if known is None:
                return Tracked(frame.index, self._phase, truth.world_from_cam, keyframes=tuple(self._new))
            return Tracked(frame.index, self._phase, known.world_from_cam, known.confidence, tuple(self._new))

    def finish(self) -> Trajectory:
        """The stream is over: last keyframes, global optimization and the final refinement (mapper.refinement).

        Returns every frame's pose, NaN where there is none. Called again it does nothing more.
        """
        with self._lock:
            if self._trajectory is None:
                self._check_open()
                with self._at_work():
                    self._graph.end()
                if self._trajectory is None:
                    raise TypeError("the tracker's node sends no Trajectory at the end of the stream")
                self._over = "the stream was finished; Mapping.load goes on with what save has left"
            return self.trajectory

    def refine(self, iterations: int) -> None:
        """More iterations over all keyframes and the frames between them, after `finish`; the splats stay the same
        ones. Learning rates go on from where they are, down to those that a map is finished with."""
        with self._lock:
            if self._trajectory is None:
                raise RuntimeError("refine is for a finished map: finish() the stream before")
            if iterations < 0:
                raise ValueError(f"{iterations} iterations: a number of at least 0")
            if not isinstance(self._mapper, Mapper):
                raise RuntimeError("mapper=frozen leaves the map as it is")
            mapper = self._atlas.current
            rate = mapper.trainer.rate
            with self._at_work():
                for done in range(1, iterations + 1):
                    mapper.refine(done, iterations, rate, prune=False)

    def render(
        self, world_from_cam: np.ndarray, intrinsics: Numbers | None = None, size: tuple[int, int] | None = None
    ) -> View:
        """The map, as it is now, from a pose (4, 4); see `GaussianMap.render`. RuntimeError where there is none yet."""
        return self.map.render(world_from_cam, intrinsics, size)

    def save(self, folder: str | Path, *, images: bool = True) -> Path:
        """Writes the map as it is now: map.ply, cameras.json and trajectory.txt, for `mvsgs view`, `export`, `render`,
        and what `Mapping.load` goes on with and `mvsgs info` shows (not where poses were given).

        images: each keyframe's image, too; `warnings` says how many could not be. An earlier save there is replaced;
        where that fails, `Mapping.load` goes on with the earlier one or with this one.
        Raises OSError; ValueError for the output of a run, for a folder where files of others would be replaced, and
        for the root of the file system and the home folder themselves; RuntimeError where there is no map yet, or
        nothing new since it was loaded.
        """
        with self._lock:
            self._check_map()
            if not isinstance(self._mapper, Mapper):
                raise RuntimeError("mapper=frozen leaves the map as it is: there is nothing new to save")
            path, node = Path(folder).expanduser(), self._graph.nodes["tracker"]
            if isinstance(node, Tracker) and not node.core.mapped:
                raise RuntimeError("no frame has come since the map was loaded: there is nothing new to save")
            source, track = source_camera(self.statistics), self._trajectory and self.trajectory
            keep_tracker = node.core.keep_map if isinstance(node, Tracker) else None
            if left_out := save_map(path, self._atlas, source, track, images, self._came, keep_tracker):
                self._mapper.stats.warn(
                    f"{left_out} of {len(self._atlas.largest.views)} keyframes were saved without an image: it was let "
                    "go (mapper.max_keyframes), found no room on the disk, or is of a stream before that was saved "
                    "without images, and smaller (mapper.max_pixels) or as its rolling shutter took it"
                )
            return path

    def export(self, path: str | Path, **options: Any) -> Path:
        """To .ply, .splat, .spz, .glb, .obj, cameras.json, transforms.json or a COLMAP folder; see
        `GaussianMap.export`."""
        return self.map.export(path, **options)

    @property
    def map(self) -> GaussianMap:
        """The map as it is now, which stays so. Raises RuntimeError where there is none yet, and says why."""
        with self._lock:
            self._check_map()
            if self._map is None:
                shown = self._atlas.largest
                snapshot = shown.snapshot()
                cameras, source = cameras_of(snapshot, shown.views), source_camera(self.statistics)
                loaded = () if self._loaded is None else tuple(self._loaded / name for name in ("map.ply", CAMERAS))
                self._map = GaussianMap(snapshot, cameras, source, sources=loaded)
            return self._map

    @property
    def keyframes(self) -> list[PosedKeyframe]:
        """All so far, in the order of the stream, with every correction so far."""
        with self._lock:
            return [self._keyframes[index] for index in sorted(self._keyframes)]

    @property
    def trajectory(self) -> Trajectory:
        """Every frame's pose as it stands in the map, once the stream is finished. RuntimeError before."""
        with self._lock:
            if self._trajectory is None:
                raise RuntimeError("every frame's pose is known after finish(); until then there are the keyframes'")
            shown = self._atlas.largest
            if not shown.views:
                return self._trajectory
            snapshot = self.map.snapshot if len(shown.state) else shown.snapshot()
            return self._trajectory.following(snapshot.keyframes, snapshot.world_from_cam)

    @property
    def warnings(self) -> list[str]:
        """What a user should know: lost tracking, doubtful focal length, refused input and steps."""
        with self._lock:
            return [f"{name}: {line}" for name, node in self._graph.nodes.items() for line in node.stats.warnings]

    @property
    def statistics(self) -> dict[str, dict[str, Any]]:
        """What each node counted, timed and skipped, by slot, as in a run's report."""
        with self._lock:
            return {name: stats_of(node.stats) for name, node in self._graph.nodes.items()}

    @property
    def _atlas(self) -> Atlas:
        return self._mapper.atlas

    def _observe(self, slot: str, node: Node, message: Any) -> None:
        """What the tracker says on its way to the other nodes, and images on theirs to the mapper."""
        if isinstance(message, FusedKeyframe):
            self._keep_image(message)
        if slot != "tracker":
            return
        if isinstance(message, Keyframe):
            posed = PosedKeyframe(message.index, message.timestamp, message.world_from_cam, message.segment)
            self._keyframes[message.index] = posed
            self._new.append(message.index)
        elif isinstance(message, Poses):
            segments = [None] * len(message.index) if message.segment is None else message.segment.tolist()
            for index, pose, segment in zip(message.index.tolist(), message.world_from_cam, segments, strict=True):
                known = self._keyframes.get(index)
                if known is not None:  # not one of a map that was begun on
                    segment = known.segment if segment is None else segment
                    self._keyframes[index] = replace(known, world_from_cam=pose, segment=segment)
        elif isinstance(message, CameraPose):
            self._pose = message
        elif isinstance(message, TrackerPhase):
            self._phase = message.phase
        elif isinstance(message, TrajectoryMessage):
            self._trajectory = Trajectory(**vars(message))

    def _keep_image(self, keyframe: FusedKeyframe) -> None:
        """For `save`, where the mapper is trained on another one: as a rolling shutter took it, or a smaller one."""
        if keyframe.photograph is not None or self._mapper.config.max_pixels is not None:
            with suppress(OSError):  # a disk that is full costs images, which `save` says
                self._came[keyframe.index] = on_disk(from_numpy(np.array(keyframe.image)))

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        self._map = None
        try:
            yield
        except BaseException as error:
            self._end_early(f"{type(error).__name__}: {error}")
            raise

    def _end_early(self, reason: str) -> None:
        with self._lock:
            if not self._over:
                self._over = f"the stream was ended by {reason}"
                self._graph.abort(reason)

    def _check_open(self) -> None:
        if self._over:
            raise RuntimeError(self._over)

    def _check_map(self) -> None:
        if len(self._atlas.largest.state):
            return
        reasons = [node.stats.values.get("nothing") for node in self._graph.nodes.values()]
        lens, waits = self._frames.lens, "depth needs a few keyframes"
        if lens is not None and lens.guessed and not self._keyframes:
            waits = "keyframes wait until the focal length, which nobody gave, is settled"
        why = "; ".join(filter(None, reasons)) or f"the tracker is {self._phase}, and {waits}"
        raise RuntimeError(f"there is no map yet: {why}")


def _check_setting(word: str) -> None:
    """Raises TypeError, ValueError for what is none of a Mapping's."""
    if not isinstance(word, str):
        raise TypeError(f"{word!r}: a setting is a text like 'mapper.iterations=300'; of a list: Mapping(*settings)")
    root = parse(word).key_or_group.partition(".")[0]
    if root not in (*SLOTS, *SETTINGS):
        raise ValueError(f"{word}: a Mapping has settings of {', '.join((*SLOTS, *SETTINGS))}")


__all__ = ["Mapping", "PosedKeyframe", "Tracked"]
