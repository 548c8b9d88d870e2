"""The factor graph: edges that say where the cells of one keyframe are in another, revised by the update operator."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from mvsgs_core.droid.adjustment import GLOBAL, LOCAL, solve
from mvsgs_core.droid.config import CorrelationKind
from mvsgs_core.droid.networks import Correlation, Networks
from mvsgs_core.droid.proximity import Pair
from mvsgs_core.droid.video import Video
from mvsgs_core.tracking.estimation.bundle_adjustment import Solution

_MOTION_LIMIT = 64.0  # cells, of the motion that the update operator gets
_FAR = 1e4  # cells: coordinates beyond are all the same to a lookup, and no risk to single precision
_SOURCES_AT_ONCE = 8  # keyframes whose edges a global update revises together
_INACTIVE_REACH = 3  # keyframes before the first free one that inactive edges may touch


@dataclass
class Edge:
    source: int  # positions in the video
    to: int
    target: np.ndarray  # (h, w, 2) float32 coordinates in `to`
    weight: np.ndarray  # (h, w, 2) float32, 0 to 1
    hidden: Tensor | None  # (128, h, w); None once inactive
    correlation: Correlation | None = None  # None: made for each lookup, or inactive
    age: int = 0  # updates

    @property
    def pair(self) -> Pair:
        return self.source, self.to

    def retire(self) -> None:
        self.hidden = self.correlation = None


class FactorGraph:
    """Active edges are revised by every update; inactive ones keep what they last said.

    correlation: "volume" is kept with the edge, "on_the_fly" needs little memory and more time. With `transient`
    nothing is kept: a correlation of the kind is made for each lookup, which is what global graphs can afford.
    """

    def __init__(
        self,
        video: Video,
        networks: Networks,
        *,
        correlation: CorrelationKind = "volume",
        transient: bool = False,
        max_factors: int | None = None,
        threads: int = 1,
    ) -> None:
        self.video, self.networks = video, networks
        self.correlation, self.transient = correlation, transient
        self.max_factors, self.threads = max_factors, threads
        self.active: list[Edge] = []
        self.inactive: list[Edge] = []

    def add(self, pairs: Iterable[Pair], make_room: bool = False) -> int:
        """Adds the edges that are not there yet; with `make_room` the oldest retire. Returns how many were added."""
        known = {edge.pair for edge in (*self.active, *self.inactive)}
        new = [pair for pair in dict.fromkeys(pairs) if pair not in known]
        if not new:
            return 0
        if make_room and self.max_factors is not None and len(self.active) + len(new) > self.max_factors:
            keep = max(0, self.max_factors - len(new))
            oldest = sorted(self.active, key=lambda edge: -edge.age)[: len(self.active) - keep]
            self._retire(oldest)
        source, to = np.array(new).T
        target = self.video.reproject(source, to).astype(np.float32)
        for n, (i, j) in enumerate(new):
            self.active.append(Edge(i, j, target[n], np.zeros_like(target[n]), self.video.frames[i].hidden))
        return len(new)

    def retire_older(self, age: int) -> None:
        self._retire([edge for edge in self.active if edge.age > age])

    def retire_before(self, position: int) -> None:
        """Edges whose source is before a position."""
        self._retire([edge for edge in self.active if edge.source < position])

    def forget_before(self, position: int) -> None:
        """Drops inactive edges that reach back before a position, where no update looks any more."""
        self.inactive = [edge for edge in self.inactive if min(edge.pair) >= position]

    def _retire(self, edges: Sequence[Edge]) -> None:
        gone = {id(edge) for edge in edges}
        self.active = [edge for edge in self.active if id(edge) not in gone]
        for edge in edges:
            edge.retire()
        self.inactive += edges

    def remove_keyframe(self, position: int) -> None:
        """Removes a keyframe from the video, and its edges; later positions move up by one."""
        self.video.remove(position)
        for edges in (self.active, self.inactive):
            edges[:] = [edge for edge in edges if position not in edge.pair]
            for edge in edges:
                edge.source -= edge.source > position
                edge.to -= edge.to > position

    def update(
        self, first_free: int | None = None, *, use_inactive: bool = False, motion_only: bool = False
    ) -> Solution:
        """One update of every active edge, then two Gauss-Newton steps.

        first_free: first position whose pose may move; by default the one after the first source.
        """
        self._revise(self.active, with_damping=not motion_only)
        if first_free is None:
            first_free = max(1, min(edge.source for edge in self.active) + 1)
        edges = list(self.active)
        if use_inactive:
            edges += [edge for edge in self.inactive if min(edge.pair) >= first_free - _INACTIVE_REACH]
        for edge in self.active:
            edge.age += 1
        return solve(self.video, edges, first_free, LOCAL, motion_only=motion_only, threads=self.threads)

    def update_globally(self) -> Solution:
        """One update of the whole graph, in portions; all poses but the first are free."""
        for start in range(0, len(self.video), _SOURCES_AT_ONCE):
            part = [edge for edge in self.active if start <= edge.source < start + _SOURCES_AT_ONCE]
            if part:
                self._revise(part, with_damping=True)
        return solve(self.video, self.active, 1, GLOBAL, motion_only=False, threads=self.threads)

    def _revise(self, edges: Sequence[Edge], with_damping: bool) -> None:
        frames = self.video.frames
        source, to = np.array([edge.pair for edge in edges]).T
        coords = np.clip(self.video.reproject(source, to), -_FAR, _FAR).astype(np.float32)
        h, w = coords.shape[1:3]
        here = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).astype(np.float32)
        target = np.stack([edge.target for edge in edges])
        motion = np.concatenate([coords - here, target - coords], axis=-1).clip(-_MOTION_LIMIT, _MOTION_LIMIT)
        revision = self.networks.revise(
            [_present(edge.hidden) for edge in edges],
            [_present(frames[edge.source].context) for edge in edges],
            (self._correlation(edge) for edge in edges),  # one at a time: transient ones are large
            coords,
            motion,
            source if with_damping else None,
        )
        moved = coords + revision.delta
        for n, edge in enumerate(edges):
            edge.hidden, edge.target, edge.weight = revision.hidden[n], moved[n], revision.weight[n]
        if revision.damping is not None:
            for position, damping in zip(np.unique(source).tolist(), revision.damping):
                frames[position].damping = damping.astype(np.float64)

    def _correlation(self, edge: Edge) -> Correlation:
        if edge.correlation is not None:
            return edge.correlation
        frames = self.video.frames
        made = self.networks.correlation(frames[edge.source].features, frames[edge.to].features, self.correlation)
        if not self.transient:
            edge.correlation = made
        return made


def _present(tensor: Tensor | None) -> Tensor:
    assert tensor is not None, "an edge begins at a frame without context, or is inactive"
    return tensor


__all__ = ["Edge", "FactorGraph"]
