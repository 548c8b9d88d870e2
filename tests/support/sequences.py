"""Synthetic sequences of the tracking tests, and how far a trajectory is from the truth."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig, Update
from mvsgs_core.trajectory import Trajectory


@functools.cache
def _rendered(options: tuple[tuple[str, Any], ...]) -> tuple[Item, ...]:
    return tuple(open_dataset("synthetic", threads=1, **dict(options)))


def synthetic(**options: Any) -> tuple[Item, ...]:
    """Frames of the synthetic room, rendered once."""
    return _rendered(tuple(sorted(options.items())))


def track(items: Sequence[Item], config: TrackerConfig | None = None) -> tuple[Tracker, Trajectory, list[Update]]:
    """A tracker that has seen all of them."""
    tracker = Tracker(config)
    updates = [tracker.add(i.index, i.timestamp, i.image, i.intrinsics, mask=i.mask) for i in items]
    updates += tracker.finish()
    return tracker, tracker.trajectory(), updates


@functools.cache
def tracked_room() -> tuple[Tracker, Trajectory, list[Update]]:
    """The easy case, tracked once: 80 frames of the room."""
    return track(synthetic(frames=80))


def members_of(tracker: Tracker) -> list[int]:
    """Keyframes of the part of the map that the camera is in, in order."""
    return tracker.session.local_map.members(tracker.session.segment)


def ate(trajectory: Trajectory, items: Sequence[Item], chosen: np.ndarray | None = None) -> tuple[float, float]:
    """RMS position error after Sim(3) alignment over all frames with a pose, and the length of the true trajectory."""
    truth = {i.index: i.world_from_cam for i in items}
    use = np.isfinite(trajectory.world_from_cam).all(axis=(1, 2)) & (True if chosen is None else chosen)
    found = trajectory.world_from_cam[use, :3, 3]
    wanted = np.stack([np.asarray(truth[int(n)])[:3, 3] for n in trajectory.index[use]])
    aligned = geometry.umeyama(found, wanted).apply(found)
    length = float(np.linalg.norm(np.diff(wanted, axis=0), axis=1).sum())
    return float(np.sqrt(np.mean(np.sum(np.square(aligned - wanted), axis=1)))), length
