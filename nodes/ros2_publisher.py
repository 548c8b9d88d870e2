"""CameraPose, Keyframe, Poses, FusedKeyframe, Preview, Reply -> Request, ROS 2: poses, depth, the map; services."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from msgs import Asked, CameraPose, FusedKeyframe, Keyframe, Poses, Preview, Reply, Request
from mvsgs_core.camera import scale_intrinsics
from mvsgs_core.datasets.ros import camera_info_topic
from mvsgs_core.geometry import scaled
from nodes import Node
from nodes.odometry import Odometry
from nodes.ros2 import forms
from nodes.ros2.connection import DEFAULT, LATCHED, TF, Connection, Quality, check_installed
from nodes.ros2.messages import CameraInfo, Header, Image, Message, Path, PointCloud2, PoseStamped, TFMessage, Time
from nodes.ros2_services import Names, Services

if TYPE_CHECKING:
    from nodes.ros2.dds import Writer

T = TypeVar("T", bound=Message)
_REMEMBERED = 1000  # frames whose transforms were sent: a keyframe is among the last of them


@dataclass(kw_only=True)
class Frames:
    """Names of frames of reference: map -> odom -> camera -> optical."""

    map: str = "map"  # of a part of the stream that shares none with the first: map_1, map_2, ...
    odom: str = "odom"
    camera: str = "camera"  # x forward, y left, z up
    optical: str = "camera_optical_frame"  # x right, y down, z forward: of depth maps


@dataclass(kw_only=True)
class Topics:
    """Names of topics; with an empty one nothing is published."""

    pose: str = "mvsgs/pose"  # PoseStamped of the camera in the map, with every frame that is tracked
    path: str = "mvsgs/path"  # Path of the keyframes, corrected
    points: str = (
        "mvsgs/points"  # PointCloud2 of the map, when it changed (mapper.preview_period); kept for late readers
    )
    depth: str = "mvsgs/depth/image"  # Image (32FC1) of each keyframe, its CameraInfo beside it
    tf: str = "/tf"  # map -> odom -> camera
    tf_static: str = "/tf_static"  # camera -> optical; empty where the robot's description has it


@dataclass
class _Placed:
    """A keyframe as it is now."""

    stamp: Time | None  # None: only a correction came so far
    world_from_cam: np.ndarray
    scale: float
    segment: int | None


class Ros2Publisher(Node):
    """What a robot needs, while the map grows. Only watches: the run goes on without it.

    Stamps are those of the images, so that time may be a simulation's. The axes are ROS's; the map begins at the first
    keyframe's camera, level if that is. Lengths are in the map's unit, which a single camera cannot know: `unit`.
    """

    @dataclass(kw_only=True)
    class Config(Connection):
        frames: Frames = field(default_factory=Frames)
        topics: Topics = field(default_factory=Topics)
        services: Names = field(default_factory=Names)
        output: str | None = None  # of the run
        maps: str | None = None  # folder in which save_map, load_map and reset leave maps; null: OUTPUT/maps
        load: str | None = None  # the map of load_map, output of a run that kept it; null: the newest in `maps`
        unit: float = 1.0  # meters in one unit of the map, where you know it
        # of the map: camera: the first keyframe's, which are turned into ROS's; ros: those already, as of poses that
        # were given in one of ROS's frames, by dataset.fixed_frame with tracker=ground_truth
        axes: Literal["camera", "ros"] = "camera"
        reliable: bool = True  # pose, path and depth; false: best effort, which readers that ask for more do not get
        queue: int = DEFAULT.depth  # messages of a topic that a slow reader may be behind
        max_points: int = 100000  # of the map; more are thinned evenly
        min_opacity: float = 0.5  # of splats that are shown as points

        def __post_init__(self) -> None:
            super().__post_init__()
            if not self.unit > 0 or self.queue < 1 or self.max_points < 1:
                raise ValueError("unit must be above 0, queue and max_points at least 1")
            names = list(vars(self.frames).values())
            if not all(names) or len(set(names)) < len(names):
                raise ValueError(f"frames must have four different names, got {names}")
            for name in filter(None, (*vars(self.topics).values(), *vars(self.services).values())):
                self.topic(name)

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        from nodes.ros2.dds import Participant

        c, topics = self.config, self.config.topics
        self._turn = forms.BODY_FROM_OPTICAL if c.axes == "camera" else np.eye(4)
        self._participant = Participant(c)
        live = Quality(c.reliable, c.queue)
        self._pose = self._writer(topics.pose, PoseStamped, live)
        self._path = self._writer(topics.path, Path, live)
        self._points = self._writer(topics.points, PointCloud2, LATCHED)
        self._depth = self._writer(topics.depth, Image, live)
        self._info = self._writer(camera_info_topic(topics.depth) if topics.depth else "", CameraInfo, live)
        self._tf = self._writer(topics.tf, TFMessage, TF)
        self._tf_static = self._writer(topics.tf_static, TFMessage, LATCHED)
        self._maps = FilePath(c.maps or FilePath(c.output or ".") / "maps").expanduser().absolute()
        self._services: Services | None = None  # once it is known whether anybody hears
        self._odometry = Odometry()  # goes on through all maps
        self._begin()
        self._newest, self._newest_stamp = float("-inf"), Time(0, 0)  # timestamp of a pose
        self._awaited = self._replied = 0  # numbers of the last request for another map, and of the last reply
        self._write(self._tf_static, self._static_transform())
        where = f"domain {c.number} on interface={c.interface}"
        self.stats.values["ros2"] = where
        logging.info("publishing to ROS 2: %s", where)

    def _begin(self) -> None:
        """A map."""
        self._by_frame = False  # the tracker sends CameraPose
        self._keyframes: dict[int, _Placed] = {}
        self._sent: dict[int, None] = {}  # frames with their transforms, the newest last
        self._shown: tuple[int, int] | None = None  # keyframe and iterations of the map that is published

    @classmethod
    def check(cls, config: Config) -> None:
        check_installed()

    @classmethod
    def unused_inputs(cls, config: Config) -> frozenset[type]:
        return frozenset() if any(vars(config.services).values()) else frozenset({Request, Reply})

    def on_idle(self) -> list[Request] | None:
        """What was asked since."""
        if Request in self.unread:
            return None
        if self._services is None:
            self._services = Services(self._participant, self.config, self.config.services, self.stats)
        return self._services.new(self._maps, self.config.load) or None

    def on_reply(self, reply: Reply) -> Iterator[None]:
        self._replied = max(self._replied, reply.number)
        if self._services is not None:
            self._services.reply(reply)
        yield from ()

    def on_request(self, request: Request) -> Iterator[None]:
        """From the tracker, in its place among the poses: those that follow are of another map."""
        new = request.number > self._awaited  # a tracker that was started again sends the last one once more
        if new and not request.problem and request.asked in (Asked.RESET, Asked.LOAD_MAP):
            self._begin()
            self._awaited = request.number
            nothing = np.zeros((0, 3))
            self._write(self._points, forms.point_cloud(self._at_map(0), nothing, nothing.astype(np.uint8)))
        yield from ()

    def on_end(self) -> Iterator[None]:
        self._answer("the run has ended; its map is in its output")
        yield from ()

    def on_abort(self, reason: str) -> None:
        self._answer(f"the run was stopped: {reason}")

    def _answer(self, why: str) -> None:
        if self._services is not None:
            self._services.close(why)

    def on_camera_pose(self, message: CameraPose) -> Iterator[None]:
        self._by_frame = True
        odom_from_cam = self._odometry.follow(message.world_from_cam, message.world_from_previous)
        self._send_pose(message, message.segment, message.world_from_cam, odom_from_cam)
        yield from ()

    def on_keyframe(self, message: Keyframe) -> Iterator[None]:
        before = max((k for k, placed in self._keyframes.items() if placed.stamp is not None), default=None)
        placed = self._keyframes.get(message.index)
        if placed is None:
            placed = _Placed(None, message.world_from_cam.copy(), message.scale, message.segment)
            self._keyframes[message.index] = placed
        placed.stamp = _stamp(message)
        placed.segment = message.segment if placed.segment is None else placed.segment
        if message.index not in self._sent:
            pose = placed.world_from_cam
            if self._by_frame:  # one of the first, which were solved together
                odom_from_cam = self._odometry.place(pose)
            else:
                last = None if before is None else self._keyframes[before]
                known = last is not None and last.segment == placed.segment
                odom_from_cam = self._odometry.follow(pose, last.world_from_cam if last and known else None)
            self._send_pose(message, placed.segment, pose, odom_from_cam)
        self._send_path(placed.segment)
        yield from ()

    def on_poses(self, poses: Poses) -> Iterator[None]:
        for i, index in enumerate(poses.index.tolist()):
            segment = None if poses.segment is None else int(poses.segment[i])
            pose, scale = poses.world_from_cam[i].copy(), float(poses.scale[i])
            known = self._keyframes.get(index)
            if known is None:
                self._keyframes[index] = _Placed(None, pose, scale, segment)
            else:
                known.world_from_cam, known.scale = pose, scale
                known.segment = known.segment if segment is None else segment
        yield from ()

    def on_fused_keyframe(self, fused: FusedKeyframe) -> Iterator[None]:
        placed = self._keyframes.get(fused.index)
        scale = self.config.unit * (1.0 if placed is None else placed.scale / fused.scale)
        size = fused.depth.shape[0], fused.depth.shape[1]
        intrinsics = scale_intrinsics(fused.intrinsics, fused.image.shape[:2], size)
        at = forms.header(_stamp(fused), self.config.frames.optical)
        self._write(self._info, forms.camera_info(at, intrinsics, size))
        self._write(self._depth, forms.depth_image(at, np.float32(scale) * fused.depth))
        yield from ()

    def on_preview(self, preview: Preview) -> Iterator[None]:
        """Until the mapper has replied to the request for another map, previews are of the one before."""
        state = preview.index, preview.iterations
        if self._points is not None and state != self._shown and self._replied >= self._awaited:
            self._shown = state
            self._write(self._points, self._cloud(preview))
        yield from ()

    def _send_pose(
        self, message: CameraPose | Keyframe, segment: int, world_from_cam: np.ndarray, odom_from_cam: np.ndarray
    ) -> None:
        """Its transforms, and its pose if it is the newest: of an earlier frame nobody asks where the camera is."""
        frames, unit = self.config.frames, self.config.unit
        world, stamp = self._map(segment), _stamp(message)
        map_from_odom = self._turn @ scaled(self._odometry.map_from_odom, unit) @ self._turn.T
        transforms = [
            forms.transform(stamp, world, frames.odom, map_from_odom),
            forms.transform(stamp, frames.odom, frames.camera, self._posed(odom_from_cam)),
        ]
        self._write(self._tf, TFMessage(transforms))
        self._sent[message.index] = None
        while len(self._sent) > _REMEMBERED:
            del self._sent[next(iter(self._sent))]
        if message.timestamp > self._newest:
            self._newest, self._newest_stamp = message.timestamp, stamp
            (stamped,) = self._stamped([stamp], world, world_from_cam[None])
            self._write(self._pose, stamped)

    def _send_path(self, segment: int) -> None:
        """The keyframes of a part of the stream as they are now; it grows, and is not made for nobody."""
        if self._path is None or not self._path.readers:
            return
        world = self._map(segment)
        placed = [p for _, p in sorted(self._keyframes.items()) if p.segment == segment and p.stamp is not None]
        stamps = [p.stamp for p in placed if p.stamp is not None]
        poses = self._stamped(stamps, world, np.stack([p.world_from_cam for p in placed]))
        self._write(self._path, Path(poses[-1].header, poses))

    def _cloud(self, preview: Preview) -> PointCloud2:
        c = self.config
        placed = self._keyframes.get(preview.index)
        segment = 0 if placed is None or placed.segment is None else placed.segment
        seen = np.flatnonzero((preview.opacities >= c.min_opacity) & np.isfinite(preview.means).all(axis=1))
        seen = seen[:: max(1, -(-len(seen) // c.max_points))]
        means = preview.means[seen].astype(np.float64)
        world = means if preview.origin is None else means + preview.origin
        points = c.unit * world @ self._turn[:3, :3].T
        return forms.point_cloud(self._at_map(segment), points, preview.colors[seen])

    def _at_map(self, segment: int) -> Header:
        return forms.header(self._newest_stamp, self._map(segment))

    def _stamped(self, stamps: list[Time], world: str, world_from_cam: np.ndarray) -> list[PoseStamped]:
        """Of poses (N, 4, 4)."""
        poses = forms.poses(self._posed(world_from_cam))
        return [PoseStamped(forms.header(t, world), pose) for t, pose in zip(stamps, poses, strict=True)]

    def _posed(self, world_from_cam: np.ndarray) -> np.ndarray:
        """Poses (..., 4, 4) with ROS's axes, in meters."""
        return forms.body_pose(world_from_cam, self.config.unit, self._turn)

    def _static_transform(self) -> TFMessage:
        frames = self.config.frames
        return TFMessage([forms.transform(0.0, frames.camera, frames.optical, forms.BODY_FROM_OPTICAL)])

    def _map(self, segment: int) -> str:
        return self.config.frames.map + (f"_{segment}" if segment else "")

    def _writer(self, topic: str, message_type: type[T], quality: Quality) -> Writer[T] | None:
        return self._participant.writer(self.config.topic(topic), message_type, quality) if topic else None

    def _write(self, writer: Writer[T] | None, message: T) -> None:
        if writer is None:
            return
        with self.stats.time("publish"):
            if writer.write(message):
                self.stats.count("published")
            else:
                self.stats.skip("messages that a reader was too slow for")


def _stamp(message: CameraPose | Keyframe | FusedKeyframe) -> Time:
    """By the clock of who took the image; where that is not known, the time in the stream."""
    return Time.at(message.stamp) if message.stamp else Time.of(message.timestamp)
