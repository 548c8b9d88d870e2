"""A robot's frames of reference as ROS's /tf has them, one above the other: where one was in another at a time."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mvsgs_core import geometry

MOVING, STATIC = TOPICS = ("/tf", "/tf_static")
MOST = 1000  # frames
DEEPEST = 50  # frames above a camera
GAP = 2 * 10**9  # ns between two transforms, beyond which nobody knows what was between them


@dataclass
class _Link:
    """Where a frame is in the one above it."""

    parent: str
    times: list[int] = field(default_factory=list)  # ns, ascending; none: it never moves
    poses: list[np.ndarray] = field(default_factory=list)  # (4, 4) parent_from_frame; one where it never moves

    def at(self, time: int) -> np.ndarray | None:
        """Between the two transforms around that time; None where there are none."""
        if not self.times:
            return self.poses[0]
        after = bisect_left(self.times, time)
        if after < len(self.times) and self.times[after] == time:
            return self.poses[after]
        if not 0 < after < len(self.times) or self.times[after] - self.times[after - 1] > GAP:
            return None
        before, span = after - 1, self.times[after] - self.times[after - 1]
        return geometry.interpolate(self.poses[before], self.poses[after], (time - self.times[before]) / span)


class TransformTree:
    """Takes TFMessages of ROS 1 and 2, as any library gives them; what is no transform is left out and counted."""

    def __init__(self, keep: int | None = None) -> None:
        """keep: ns before the newest transform of a frame that older ones are kept for; None: all are."""
        self.refused = 0
        self._keep = keep
        self._links: dict[str, _Link] = {}

    @property
    def frames(self) -> list[str]:
        """The names that are known."""
        return sorted({*self._links, *(link.parent for link in self._links.values())})

    def add(self, message: Any, static: bool) -> None:
        """static: of /tf_static, for all times."""
        for transform in message.transforms:
            parent, child = _named(transform.header.frame_id), _named(transform.child_frame_id)
            pose = _pose(transform.transform)
            full = child not in self._links and len(self._links) >= MOST
            if pose is None or full or not parent or not child or parent == child:
                self.refused += 1
                continue
            link = self._links.get(child)
            if link is None or link.parent != parent or static:
                link = self._links[child] = _Link(parent)
            if static:
                link.poses = [pose]
            elif link.times or not link.poses:  # what was said to stand still does
                self._insert(link, _nanoseconds(transform.header.stamp), pose)

    def pose(self, frame: str, world: str, time: int) -> np.ndarray | None:
        """(4, 4) world_from_frame at that time, ns; None where it is not known, or not yet, see `waits`."""
        chains = self._chains(frame, world)
        if chains is None:
            return None
        found = []
        for chain in chains:
            root_from_frame = np.eye(4)
            for link in chain:
                parent_from_child = link.at(time)
                if parent_from_child is None:
                    return None
                root_from_frame = parent_from_child @ root_from_frame
            found.append(root_from_frame)
        return geometry.inverse(found[1]) @ found[0]

    def waits(self, frame: str, world: str, time: int) -> bool:
        """Whether a transform that is still to come may tell it."""
        chains = self._chains(frame, world)
        return chains is None or any(link.times and link.times[-1] < time for chain in chains for link in chain)

    def connects(self, frame: str, world: str) -> bool:
        return self._chains(frame, world) is not None

    def _chains(self, frame: str, world: str) -> tuple[list[_Link], list[_Link]] | None:
        """The links from both frames up to the first that is above both; None: they are not connected."""
        (names, links), (others, other_links) = self._above(_named(frame)), self._above(_named(world))
        shared = next((name for name in names if name in others), None)
        if shared is None:
            return None
        return links[: names.index(shared)], other_links[: others.index(shared)]

    def _above(self, name: str) -> tuple[list[str], list[_Link]]:
        """A frame and those above it, and the links between them. A circle ends where it is too deep."""
        names, links = [name], []
        while names[-1] in self._links and len(names) <= DEEPEST:
            links.append(self._links[names[-1]])
            names.append(links[-1].parent)
        return names, links

    def _insert(self, link: _Link, time: int, pose: np.ndarray) -> None:
        place = bisect_left(link.times, time)
        if place < len(link.times) and link.times[place] == time:
            link.poses[place] = pose
            return
        link.times.insert(place, time)
        link.poses.insert(place, pose)
        if self._keep is not None:
            old = bisect_left(link.times, link.times[-1] - self._keep)
            del link.times[:old], link.poses[:old]


def _named(frame: str) -> str:
    """ROS 1 has a slash before some."""
    return frame.removeprefix("/")


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _pose(transform: Any) -> np.ndarray | None:
    """(4, 4); None where it is none."""
    moved, turned = transform.translation, transform.rotation
    position = np.array([moved.x, moved.y, moved.z], np.float64)
    quaternion = np.array([turned.w, turned.x, turned.y, turned.z], np.float64)
    length = float(np.linalg.norm(quaternion))
    if not 0.99 < length < 1.01:
        return None
    pose = geometry.rigid(geometry.rotation_from_quaternion(quaternion / length), position)
    return pose if geometry.is_rigid(pose) else None


__all__ = ["MOVING", "STATIC", "TOPICS", "TransformTree"]
