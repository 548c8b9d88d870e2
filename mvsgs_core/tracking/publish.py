"""What was published of each keyframe, so that only what changed is published again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from mvsgs_core.tracking.between import Between
from mvsgs_core.tracking.keyframes import Keyframe, KeyframeTable
from mvsgs_core.tracking.settling import Settling
from mvsgs_core.tracking.steps import Steps, whole
from mvsgs_core.trajectory import TrackingState

GRAY_LEVEL = 1.0 / 255.0


class Tracked(Protocol):
    """What is published of a keyframe."""

    @property
    def inverse_depth(self) -> np.ndarray: ...

    @property
    def triangulated(self) -> np.ndarray: ...  # bool, of the shape of inverse_depth

    @property
    def median_depth(self) -> float: ...


class Keyframes(Protocol):
    """Keyframes by their index: a tracker's graph, or DROID-SLAM's video."""

    @property
    def keyframes(self) -> Mapping[int, Tracked]: ...

    def world_from_cam(self, index: int) -> np.ndarray: ...


@dataclass(frozen=True)
class Correction:
    """Keyframe poses as they are now, absolute."""

    index: np.ndarray  # (K,) int64
    world_from_cam: np.ndarray  # (K, 4, 4) float64
    scale: np.ndarray  # (K,) float64: depths now over depths when the keyframe was first published
    segment: np.ndarray | None = None  # (K,) int32 part of the map that it belongs to now; None: there is only one
    exposure: np.ndarray | None = None  # (K, 3, 4) float32 color affines, see `msgs`; None: as they were
    vignetting: np.ndarray | None = None  # (3,) float32 of all images; None: as it was
    velocity: np.ndarray | None = None  # (K, 6) of the camera, see `msgs`, NaN where not known; None: as they were
    readout_time: float = 0.0  # seconds of the rolling shutter that go with them
    reads_columns: bool = False  # it reads columns, not rows


@dataclass(frozen=True)
class Update:
    """What one frame changed."""

    state: TrackingState
    keyframes: tuple[int, ...] = ()  # indices of frames that became keyframes, in order
    correction: Correction | None = None  # of keyframes published before
    between: tuple[Between, ...] = ()  # frames that are no keyframes, posed against ones that were published
    # what is left to do of the frame and takes longer, to be done before another update has a rest; its pose is known
    rest: Steps[Update] | None = field(default=None, compare=False)
    later: Settling | None = field(default=None, compare=False)  # what gives `between`, before the next keyframe

    def begun(self) -> Update:
        """With the rest of it done, and not what can be done later."""
        return self if self.rest is None else whole(self.rest)

    def following(self) -> Iterator[Update]:
        """What the rest comes to, which may have a rest of its own: one after another, each without it."""
        update = self
        while update.rest is not None:
            update = update.begun()
            yield replace(update, rest=None)

    def whole(self) -> Update:
        """With all of it done."""
        update = self.begun()
        return update if update.later is None else replace(update, between=update.later.whole(), later=None)


@dataclass
class _Published:
    world_from_cam: np.ndarray
    scale: float
    inverse_depth: np.ndarray  # when first published
    known: np.ndarray
    segment: int
    exposure: np.ndarray | None  # (3, 4) color affine; None: the identity
    looked_at: tuple[object, ...] = ()  # what the keyframe was made of when it was looked at; empty: it was not


class Light(Protocol):
    """What is known of exposures and vignetting: None, the identity."""

    def exposure(self, index: int) -> np.ndarray | None: ...

    def known(self, index: int) -> object: ...  # the same object: the same exposure

    @property
    def varies(self) -> bool: ...  # False: `known` is the same object for good

    @property
    def vignetting(self) -> np.ndarray | None: ...


class Publisher:
    """tolerance: what counts as a change, as a fraction of the median depth (positions), radians, fraction (scales); of
    exposures and vignetting it is a gray level.

    segment_of: the part of the map that a keyframe belongs to; None where the tracker has only one.
    light: exposures and vignetting; None where the tracker knows none.
    """

    def __init__(
        self,
        graph: Keyframes,
        tolerance: float,
        segment_of: Callable[[int], int] | None = None,
        light: Light | None = None,
    ) -> None:
        self.graph = graph
        self.tolerance = tolerance
        self.segment_of = segment_of
        self.light = light
        self.held: list[int] = []  # keyframes that are not published yet
        self.highest_segment = 0  # that was ever published: no number is given twice
        self.behind = False  # readers may have later corrections than `known` says: the next ones are of all keyframes
        self._published: dict[int, _Published] = {}
        self._vignetting: np.ndarray | None = None  # that was published last
        self._lit = False  # an exposure was published
        self._varied = False  # the light, when it was looked at last
        self._new: set[int] = set()  # published and not yet looked at
        self._clock = 0  # of the graph's keyframes when they were looked at last

    def publish(self, index: int) -> None:
        """A keyframe was sent as it is now, with scale 1."""
        self.known(index, None if self.light is None else self.light.exposure(index))

    def known(self, index: int, exposure: np.ndarray | None, scale: float = 1.0) -> None:
        """Readers have a keyframe as it is now, with this scale and exposure (3, 4); None: the identity."""
        keyframe, segment = self.graph.keyframes[index], self._segment(index)
        known, pose = keyframe.triangulated.copy(), self.graph.world_from_cam(index)
        first = scale * keyframe.inverse_depth
        self._published[index] = _Published(pose, scale, first, known, segment, exposure)
        self._new.add(index)
        self._lit |= exposure is not None
        self.highest_segment = max(self.highest_segment, segment)

    def known_vignetting(self, vignetting: np.ndarray) -> None:
        """Readers have this vignetting (3,); zeros: none."""
        self._vignetting = vignetting.astype(np.float32)

    def exposure(self, index: int) -> np.ndarray | None:
        """(3, 4) of a keyframe as it was published last; None: the identity."""
        return self._published[index].exposure

    def scale(self, index: int) -> float:
        """Depths of a published keyframe now, over those when it was first published."""
        return self._scale(index, self._published[index])

    @property
    def published(self) -> set[int]:
        return set(self._published)

    def publish_all(self, indices: list[int], settled: bool) -> tuple[int, ...]:
        """Keyframes that may go out now: these, and those held back before; none until the focal length is settled."""
        self.held += indices
        if not settled:
            return ()
        out, self.held = tuple(self.held), []
        for index in out:
            self.publish(index)
        return out

    def corrections(self, everything: bool = False) -> Correction | None:
        """Keyframes that moved noticeably, or joined another segment, since they were last published; else None.

        everything: all that were published.
        """
        moved = []
        everything, self.behind = everything or self.behind, False
        vignetting = changed_vignetting(None if self.light is None else self.light.vignetting, self._vignetting)
        if vignetting is not None:
            everything, self._vignetting = True, vignetting
        for index in self._to_look_at(everything):
            last = self._published[index]
            parts = self._parts(index)
            if not everything and parts and same(parts, last.looked_at):
                continue
            exposure = None if self.light is None else self.light.exposure(index)
            pose, scale, segment = self.graph.world_from_cam(index), self._scale(index, last), self._segment(index)
            depth = self.graph.keyframes[index].median_depth
            shift = np.linalg.norm(pose[:3, 3] - last.world_from_cam[:3, 3]) / depth
            turn = np.linalg.norm(pose[:3, :3] - last.world_from_cam[:3, :3]) / np.sqrt(2.0)
            moves = max(shift, turn, abs(np.log(scale / last.scale))) > self.tolerance
            if everything or moves or last.segment != segment or differ(exposure, last.exposure):
                last.world_from_cam, last.scale, last.segment, last.exposure = pose, scale, segment, exposure
                self._lit |= exposure is not None
                moved.append(index)
            last.looked_at = parts
        if not moved:
            return None
        last_of = [self._published[index] for index in moved]
        return Correction(
            np.array(moved, np.int64),
            np.stack([last.world_from_cam for last in last_of]),
            np.array([last.scale for last in last_of], np.float64),
            None if self.segment_of is None else np.array([last.segment for last in last_of], np.int32),
            np.stack([affine_of(last.exposure) for last in last_of]) if self._lit else None,
            vignetting,
        )

    def _to_look_at(self, everything: bool) -> list[int]:
        """Published keyframes that may have changed since the last time, in the order in which they were published."""
        keyframes, light = self.graph.keyframes, self.light
        new, self._new = self._new, set()
        if isinstance(keyframes, KeyframeTable):
            varied, self._varied = self._varied, light is not None and light.varies
            changed = keyframes.changed(self._clock) | new
            self._clock = keyframes.clock
            if not (everything or varied or self._varied):
                return [index for index in self._published if index in changed and index in keyframes]
        return [index for index in self._published if index in keyframes]

    def _parts(self, index: int) -> tuple[object, ...]:
        """What a keyframe's corrections are made of; empty where it may change in place. Of thousands few do."""
        keyframe = self.graph.keyframes[index]
        if not isinstance(keyframe, Keyframe):
            return ()
        light = None if self.light is None else self.light.known(index)
        segment = self._segment(index)
        return keyframe.cam_from_world, keyframe.inverse_depth, keyframe.information, segment, light

    def _segment(self, index: int) -> int:
        return 0 if self.segment_of is None else self.segment_of(index)

    def _scale(self, index: int, published: _Published) -> float:
        keyframe = self.graph.keyframes[index]
        known = keyframe.triangulated & published.known
        if known.sum() < 20:
            return published.scale
        return float(np.median(published.inverse_depth[known] / keyframe.inverse_depth[known]))


def same(parts: tuple[object, ...], others: tuple[object, ...]) -> bool:
    """Whether these are the same objects, or numbers."""
    return len(parts) == len(others) and all(a is b or (type(a) is int and a == b) for a, b in zip(parts, others))


def changed_vignetting(now: np.ndarray | None, before: np.ndarray | None) -> np.ndarray | None:
    """(3,) the vignetting now, zeros for none, where it differs from that of before by a gray level; else None."""
    there, last = (np.zeros(3, np.float32) if v is None else v for v in (now, before))
    radius = np.linspace(0.0, 1.0, 9)
    powers = np.stack([radius**2, radius**4, radius**6], axis=1)
    return there if np.abs(powers @ (there - last)).max() > GRAY_LEVEL else None


def affine_of(exposure: np.ndarray | None) -> np.ndarray:
    """(3, 4) float32: the identity where there is none."""
    return np.eye(3, 4, dtype=np.float32) if exposure is None else exposure


def differ(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Whether two exposures (3, 4) give black, gray or white by a gray level differently."""
    off = affine_of(a) - affine_of(b)
    return bool(max(np.abs(off[:, :3].sum(axis=1) * level + off[:, 3]).max() for level in (0.0, 0.5, 1.0)) > GRAY_LEVEL)


__all__ = [
    "Correction",
    "Keyframes",
    "Light",
    "Publisher",
    "Tracked",
    "Update",
    "affine_of",
    "changed_vignetting",
    "differ",
    "same",
]
