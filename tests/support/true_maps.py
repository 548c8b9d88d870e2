"""Keyframe graphs whose poses and depths are the truth: rendered frames of the room, and what follows from them."""

from __future__ import annotations

import functools
from itertools import pairwise

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import LucasKanade, Matches
from mvsgs_core.tracking.matching.matcher import Matcher

FRAMES = 300  # of a round through the room: frame 300 would be frame 0


@functools.cache
def _room() -> Synthetic:
    return Synthetic(frames=FRAMES, loop=True, threads=1)


@functools.cache
def item(number: int) -> Item:
    return _room()[number]


def matcher() -> Matcher:
    return Matcher(LucasKanade())


def image(number: int, index: int | None = None) -> TrackingImage:
    """A frame of the round as the tracker sees it, under another index where one is given."""
    frame = item(number)
    return TrackingImage.of(number if index is None else index, frame.timestamp, frame.image, (240, 320), False)


def seen_at(time: float, index: int) -> tuple[TrackingImage, np.ndarray]:
    """What the camera of the round sees between two frames, at a time in frames, and cam_from_world (4, 4) then."""
    pose = _room().path.pose(time)
    pixels, _ = _room().render(pose, item(0).intrinsics, (240, 320))
    return TrackingImage.of(index, time / 20.0, pixels, (240, 320), False), geometry.inverse(pose)


def true_pose(number: int, unit: float = 1.0) -> np.ndarray:
    """cam_from_world (4, 4). unit: meters that one length of the map is."""
    pose = geometry.inverse(np.asarray(item(number).world_from_cam))
    pose[:3, 3] /= unit
    return pose


def true_keyframe(number: int, unit: float = 1.0, segment: int = 0) -> Keyframe:
    frame = image(number)
    depth = item(number).depth
    assert depth is not None
    u, v = frame.cells.points.astype(int).T
    inverse_depth = unit / depth[v, u].astype(np.float64)
    return Keyframe(frame, true_pose(number, unit), inverse_depth, 1e3 / inverse_depth**2, segment)


def true_graph(*numbers: int, unit: float = 1.0, segment: int = 0) -> KeyframeGraph:
    graph = KeyframeGraph(item(0).intrinsics)
    for number in numbers:
        graph.add(true_keyframe(number, unit, segment))
    return graph


def exact_matches(graph: KeyframeGraph, source: int, cam_from_world: np.ndarray) -> Matches:
    """Where the textured points of a keyframe are seen by a camera at this pose, to the last digit."""
    target, inside = graph.predict_pose(source, cam_from_world)
    seen = inside & graph.keyframes[source].image.cells.textured
    return Matches(np.where(seen[:, None], target, np.nan), seen.astype(np.float64))


def tie(graph: KeyframeGraph, *indices: int) -> None:
    """Edges between each of these keyframes and the next one."""
    for a, b in pairwise(indices):
        assert graph.connect(a, b, exact_matches(graph, a, graph.keyframes[b].cam_from_world), 0.1)


def shuffled(number: int, index: int) -> TrackingImage:
    """The tiles of a frame in another order: everything of the place is seen, and nothing where it belongs."""
    pixels = item(number).image
    tiles = pixels.reshape(3, 80, 4, 80, 3).swapaxes(1, 2).reshape(12, 80, 80, 3)
    mixed = tiles[np.random.default_rng(3).permutation(12)].reshape(3, 4, 80, 80, 3).swapaxes(1, 2)
    return TrackingImage.of(index, 0.0, mixed.reshape(240, 320, 3), (240, 320), False)


def pose_error(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """How far two cameras (4, 4) are apart: in the unit of their translations, and in radians."""
    difference = found @ geometry.inverse(true)
    return float(np.linalg.norm(difference[:3, 3])), float(np.linalg.norm(geometry.so3_log(difference[:3, :3])))
