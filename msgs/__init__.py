"""The messages that nodes exchange: frozen dataclasses of scalars and numpy arrays. No logic, no torch, no zmq.

An array's annotation says dtype and shape: `Annotated[np.ndarray, "float32 h w"]`. A number is a fixed size, a name
is a size that must be the same wherever that name stands in one message. The codec checks both.

Conventions (ARCHITECTURE.md): camera axes x right, y down, z forward; depth is z; pixel (0, 0) is the center of the
first pixel; `world_from_cam` maps camera to world coordinates; images are RGB; intrinsics are (fx, fy, cx, cy) in
pixels of the image they come with. Maps smaller than the image (`h w` against `H W`) cover the same field of view:
scale the intrinsics with `mvsgs_core.camera.scale_intrinsics`. 0 in a depth or inverse-depth map means "unknown".
A number or text with a default is left out of the wire where it has that value, so that older programs still fit.

Exposure: `exposure` is the color affine [A | b] (3, 4) from the map's colors, those of the mean camera, to the image's,
0 to 1; `vignetting` (v1, v2, v3) the sensor's brightness factor V(r) = 1 + v1 r² + v2 r⁴ + v3 r⁶, r the distance from
the principal point over half the image's diagonal: image = clip(V(r) (A color + b)). None: the identity, or not known.

`index` is the index of the frame in its stream; a keyframe keeps its frame's index as its id everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, get_args

import numpy as np

from mvsgs_core.trajectory import TrackingState as TrackingState


class Asked(StrEnum):
    """What a Request can ask."""

    PAUSE = "pause"  # the source's frames are not taken
    SAVE_MAP = "save_map"  # the map as it is, for another run to begin on; the run goes on
    LOAD_MAP = "load_map"  # goes on in a map that was saved; that of the run is saved before
    LOCALIZE = "localize"  # frames are only found in the map, which stays as it is
    RESET = "reset"  # a new map; that of the run is saved before


@dataclass(frozen=True)
class _Image:
    """What every message with an image of the stream has."""

    index: int
    timestamp: float  # seconds
    image: Annotated[np.ndarray, "uint8 H W 3"]
    intrinsics: Annotated[np.ndarray, "float64 4"]
    # when it came from the camera, seconds since 1970 by the host's clock; 0: it is of no live stream
    captured: float = field(default=0.0, kw_only=True)
    # nanoseconds by the clock of who took it, wherever that was set to, for headers alone; 0: `timestamp` is all of it
    stamp: int = field(default=0, kw_only=True)
    # of the image, and of its photograph: False where a pixel is not of the scene, as a person's; None: all are
    mask: Annotated[np.ndarray, "bool H W"] | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class _PhotographedImage(_Image):
    """What every message of an image has that the map is trained on.

    Where the tracker knows the camera's rolling shutter, it says how the image was taken: `readout_time`, and the
    camera's `velocity`, a twist (translation, rotation) a second in its own axes, in the unit of `scale`.
    """

    velocity: Annotated[np.ndarray, "float64 6"] | None = field(default=None, kw_only=True)
    readout_time: float = field(default=0.0, kw_only=True)  # seconds from the photograph's first row to its last
    reads_columns: bool = field(default=False, kw_only=True)  # from its first column to its last, that is


@dataclass(frozen=True)
class _PosedImage(_PhotographedImage):
    """What every message of a keyframe has.

    Where the rolling shutter is known, `image` is as a global shutter would have taken it, for stereo, and there is
    the `photograph` as it was taken, too.
    """

    world_from_cam: Annotated[np.ndarray, "float64 4 4"]
    scale: float  # the map's scale that pose and depths are in, see Poses; 1 when first sent
    exposure: Annotated[np.ndarray, "float32 3 4"] | None = field(default=None, kw_only=True)
    vignetting: Annotated[np.ndarray, "float32 3"] | None = field(default=None, kw_only=True)
    # as it was taken; None: the image is it
    photograph: Annotated[np.ndarray, "uint8 H W 3"] | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Frame(_Image):
    """One image of the stream, undistorted."""

    intrinsics_guessed: bool = False  # the focal length is a guess, to be estimated by the tracker if it can
    exposure: float = 0.0  # exposure time times gain over f-number², in a unit that the stream keeps; 0: not known
    # by GPS: latitude, longitude (degrees, WGS84), altitude (m)
    place: Annotated[np.ndarray, "float64 3"] | None = field(default=None, kw_only=True)
    # fx, fy, cx, cy of the image as the camera took it, before its undistortion and scaling; None: of this image
    original_intrinsics: Annotated[np.ndarray, "float64 4"] | None = field(default=None, kw_only=True)
    # of a robot that knows where its camera is; a source sends it on as GroundTruth, and its Frames are without
    world_from_cam: Annotated[np.ndarray, "float64 4 4"] | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class GroundTruth(_Image):
    """What only the evaluator may see: the frame to score renders against, and the true pose and depth if known.

    And a tracker of given poses, see `nodes/posed_tracker.py`.
    """

    world_from_cam: Annotated[np.ndarray, "float64 4 4"] | None
    depth: Annotated[np.ndarray, "float32 H W"] | None  # in the unit of the true poses


@dataclass(frozen=True)
class Keyframe(_PosedImage):
    """A frame that the tracker keeps, with its pose and coarse inverse depth on the tracker's grid."""

    inverse_depth: Annotated[np.ndarray, "float32 h w"]
    inverse_depth_weight: Annotated[np.ndarray, "float32 h w"]  # confidence, 0 to 1
    segment: int  # part of the map; poses of two segments share no frame of reference


@dataclass(frozen=True)
class TrackedFrame(_PhotographedImage):
    """A frame that became no keyframe, never a held-out one: another view to train the map on.

    Its image is the photograph. It follows its keyframe wherever that is corrected to.
    """

    keyframe: int  # against which its pose was found
    keyframe_from_cam: Annotated[np.ndarray, "float64 4 4"]
    scale: float  # the map's scale, of that keyframe, that the pose is in, see Poses
    exposure: Annotated[np.ndarray, "float32 3 4"] | None = None  # from the keyframe's colors; None: no difference


@dataclass(frozen=True)
class Depth(_PosedImage):
    """A keyframe with its multi-view stereo depth."""

    depth: Annotated[np.ndarray, "float32 h w"]
    confidence: Annotated[np.ndarray, "float32 h w"]  # 0 to 1
    segment: int
    effort: int = 0  # that stereo made: 0 all, more: less, as the node's `efforts` say


@dataclass(frozen=True)
class FusedKeyframe(_PosedImage):
    """A keyframe with its refined and filtered depth: what the mapper adds to the map."""

    depth: Annotated[np.ndarray, "float32 h w"]  # 0 where filtered out
    confidence: Annotated[np.ndarray, "float32 h w"]  # 0 to 1
    normals: Annotated[np.ndarray, "float32 h w 3"]  # camera frame, toward the camera; 0 where depth is 0
    segment: int
    unfiltered: Annotated[np.ndarray, "float32 h w"] | None = None  # refined depth before the filters; None: not sent
    effort: int = 0  # that stereo made, see Depth
    fusion_effort: int = 0  # that fusion made


@dataclass(frozen=True)
class Poses:
    """Corrected keyframe poses after bundle adjustment or loop closure, merged by keyframe index, and exposures.

    Absolute, not differences: what was computed at `Keyframe.scale` s has its depths multiplied by scale / s.
    """

    revision: int
    index: Annotated[np.ndarray, "int64 K"]
    world_from_cam: Annotated[np.ndarray, "float64 K 4 4"]
    scale: Annotated[np.ndarray, "float64 K"]
    segment: Annotated[np.ndarray, "int32 K"] | None = None  # Keyframe.segment now: a loop joins two; None: as sent
    exposure: Annotated[np.ndarray, "float32 K 3 4"] | None = None  # of those keyframes now; None: as they were
    vignetting: Annotated[np.ndarray, "float32 3"] | None = None  # of all images now; None: as it was
    velocity: Annotated[np.ndarray, "float64 K 6"] | None = None  # of those keyframes now, NaN or None: as it was
    readout_time: float = 0.0  # seconds of the rolling shutter that go with the velocities
    reads_columns: bool = False  # it reads columns, not rows


@dataclass(frozen=True)
class CameraPose:
    """Where the tracker sees the camera, as soon as it does; nothing where it does not. For who steers or watches.

    Never sent again: later corrections are in Poses. The motion from the frame before, of which both poses are in the
    map as it is now, is free of the corrections between them.
    """

    index: int
    timestamp: float  # seconds
    world_from_cam: Annotated[np.ndarray, "float64 4 4"]
    segment: int  # part of the map, see Keyframe
    world_from_previous: Annotated[np.ndarray, "float64 4 4"] | None = None  # the frame before; None: it has no pose
    confidence: float = 0.0  # of the map's points that this pose lets one keyframe show, the fraction that is seen
    stamp: int = 0  # of its Frame


@dataclass(frozen=True)
class TrackerPhase:
    """What the tracker does from a frame on, where it changes, and of a live stream now and then; for who watches.

    It begins with "initializing".
    """

    index: int
    timestamp: float  # seconds
    phase: str  # initializing, tracking, relocalizing (searching the map for the camera) or lost
    # of a live stream: seconds from a frame's capture to its pose, median and 99th percentile so far
    latency: Annotated[np.ndarray, "float64 2"] | None = None


@dataclass(frozen=True)
class Trajectory:
    """Every frame that the tracker saw, sent once at the end; poses agree with the last Poses."""

    index: Annotated[np.ndarray, "int64 N"]
    timestamp: Annotated[np.ndarray, "float64 N"]
    world_from_cam: Annotated[np.ndarray, "float64 N 4 4"]  # NaN where there is no pose
    keyframe: Annotated[np.ndarray, "bool N"]
    state: Annotated[np.ndarray, "uint8 N"]  # TrackingState
    segment: Annotated[np.ndarray, "int32 N"]
    focal_factor: float = 1.0  # by which the tracker multiplied the focal lengths of the frames, if they were guessed
    readout_time: float = 0.0  # seconds of the rolling shutter, first row to last; 0: none that is taken account of
    exposure: Annotated[np.ndarray, "float32 N 3 4"] | None = None  # of every frame, NaN where it is not known
    vignetting: Annotated[np.ndarray, "float32 3"] | None = None
    velocity: Annotated[np.ndarray, "float64 N 6"] | None = None  # as of keyframes; None: that between the poses
    places: Annotated[np.ndarray, "float64 N 3"] | None = None  # Frame.place, NaN where there is none; None: nowhere
    # k1, k2 as OpenCV's of the frames, by the focal lengths as found; keyframes are without; None: frames have none
    distortion: Annotated[np.ndarray, "float64 2"] | None = None
    reads_columns: bool = False  # the rolling shutter reads columns, not rows
    in_order: bool = True  # one frame after the other along a path; false: photographs in any order


@dataclass(frozen=True)
class SplatMap:
    """The whole map: sent before the final refinement (`refined` False) and after it."""

    refined: bool
    iterations: int
    kernel: str  # "gaussian", "exact" or "ges_scale": what `betas` means
    origin: Annotated[np.ndarray, "float64 3"]  # world position that means are relative to: float32 needs it near
    means: Annotated[np.ndarray, "float32 N 3"]
    log_scales: Annotated[np.ndarray, "float32 N 3"]
    quaternions: Annotated[np.ndarray, "float32 N 4"]  # w first
    opacity_logits: Annotated[np.ndarray, "float32 N"]
    sh: Annotated[np.ndarray, "float32 N B 3"]  # spherical harmonics, B = (degree + 1)²
    betas: Annotated[np.ndarray, "float32 N"]
    anchors: Annotated[np.ndarray, "int64 N"]  # keyframe that the splat came from and moves with
    keyframes: Annotated[np.ndarray, "int64 K"]
    world_from_cam: Annotated[np.ndarray, "float64 K 4 4"]  # of those keyframes, as the mapper used them
    scale: Annotated[np.ndarray, "float64 K"]
    exposures: Annotated[np.ndarray, "float32 K 3 4"]  # color affine [A | b] of each keyframe
    vignetting: Annotated[np.ndarray, "float32 3"] | None = None  # that renders need beside them
    antialiased: bool = False  # renders scale a splat's opacity by what the pixels' blur makes of its area
    background: Annotated[np.ndarray, "float32 3"] | None = None  # color where there is no splat; None: black


@dataclass(frozen=True)
class Preview:
    """The map as it grows, for a viewer: never slows the mapper, newest only. All relative to SplatMap.origin."""

    index: int  # newest keyframe
    iterations: int
    world_from_cam: Annotated[np.ndarray, "float64 4 4"]
    intrinsics: Annotated[np.ndarray, "float64 4"]
    image: Annotated[np.ndarray, "uint8 H W 3"]
    render: Annotated[np.ndarray, "uint8 H W 3"]
    means: Annotated[np.ndarray, "float32 N 3"]
    covariances: Annotated[np.ndarray, "float32 N 3 3"]
    colors: Annotated[np.ndarray, "uint8 N 3"]
    opacities: Annotated[np.ndarray, "float32 N"]
    keyframes: Annotated[np.ndarray, "int64 K"] | None = None  # all, in the order of the stream; None: not said
    keyframe_poses: Annotated[np.ndarray, "float64 K 4 4"] | None = None  # of those, with every correction so far
    origin: Annotated[np.ndarray, "float64 3"] | None = None  # SplatMap.origin
    # of a live stream: seconds from a keyframe's capture to the map, median and 99th percentile so far; to a preview
    latency: Annotated[np.ndarray, "float64 2 2"] | None = None
    effort: int = 0  # that stereo made for the newest keyframe, see Depth
    fusion_effort: int = 0  # that fusion made
    # of the render, 0 where the map covers a pixel by less than half; None: not said
    depth: Annotated[np.ndarray, "float32 h w"] | None = None
    splats: Annotated[np.ndarray, "int64 K"] | None = None  # of the whole map, that came from each of the keyframes
    memory: int = 0  # bytes that the mapper holds
    coarse: int = 0  # keyframes of a live stream that get the rest of their splats when there is time


@dataclass(frozen=True)
class Request:
    """What somebody outside asks of the run, as `Asked` names it: a source sends it on in its place among the frames.

    Each stage does its part between the frames before and those after, and passes it on; the last one replies. A stage
    that cannot do its part says so in `problem`, and the stages behind it leave theirs.
    """

    number: int  # of who asks, which its Reply has too
    asked: str  # Asked
    on: bool = True  # of pause and localize; false: not any more
    folder: str = ""  # of save_map and load_map: where the map is to be, or is
    kept: str = ""  # of load_map and reset: where the run's map is to be kept
    problem: str = ""  # one line that says what to do; empty as long as there is none


@dataclass(frozen=True)
class Reply:
    """What became of a Request, once it is done or cannot be."""

    number: int  # of the Request
    success: bool
    message: str  # one line


@dataclass(frozen=True)
class End:
    """The last message of every topic. `stats` holds what each node upstream counted and timed, by node name."""

    stats: Mapping[str, Any] = field(default_factory=dict)


Message = (
    Frame
    | GroundTruth
    | Keyframe
    | TrackedFrame
    | Depth
    | FusedKeyframe
    | Poses
    | CameraPose
    | TrackerPhase
    | Trajectory
    | SplatMap
    | Preview
    | Request
    | Reply
    | End
)
TYPES: dict[str, type] = {t.__name__: t for t in get_args(Message)}
