"""Before there is a map: keyframes are collected until they can be solved."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.setting_ranges import at_least, within
from mvsgs_core.tracking.diagnosis import Diagnosis
from mvsgs_core.tracking.estimation.focal import FocalConfig, reconstructing_with_unknown_focal
from mvsgs_core.tracking.estimation.structure_from_motion import ReconstructionCriteria, reconstructing
from mvsgs_core.tracking.graph import Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import Matches, propagate
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.shared_scale import share_scale, tied_parts
from mvsgs_core.tracking.steps import Steps, whole


@dataclass(frozen=True)
class InitializationConfig:
    min_keyframes: int = 6  # before an initialization is tried
    max_keyframes: int = 10  # that wait for one; the oldest goes first
    flow: float = 0.035  # of the longer side: median flow between them; falls to a third while the camera is slow
    patience: int = 40  # frames without a keyframe over which it falls
    recent: int = 5  # keyframes before that each is matched with
    min_fraction: float = 0.25  # of the textured points that an edge must have found
    weak_fraction: float = 0.15  # the same where without such edges the scale between the keyframes is open
    criteria: ReconstructionCriteria = field(default_factory=ReconstructionCriteria)
    forced: ReconstructionCriteria = field(
        default_factory=lambda: ReconstructionCriteria(
            max_cost=1.0, min_turn_error=0.3, min_parallax=1.0, min_baseline=0.01
        )
    )  # at the end of the stream

    def __post_init__(self) -> None:
        at_least(self, min_keyframes=2, max_keyframes=2, flow=0, patience=1, recent=1)
        within(self, min_fraction=(0, 1), weak_fraction=(0, 1))


class Initializer:
    """The keyframes of a segment that has no map yet."""

    def __init__(
        self, graph: KeyframeGraph, matcher: Matcher, config: InitializationConfig, threads: int, diagnosis: Diagnosis
    ) -> None:
        self.graph = graph
        self.matcher = matcher
        self.config = config
        self.threads = threads
        self._guess = graph.intrinsics  # (4,) that came with the frames
        self.waiting: list[int] = []
        self._weak: dict[tuple[int, int], Matches] = {}  # of pairs of them, too few for an edge
        self.diagnosis = diagnosis
        self._segment = 0  # of the waiting keyframes

    @property
    def reason(self) -> str:
        """Why there is no map yet."""
        return self.diagnosis.reason(self.config.min_keyframes)

    def flow(self, since: int) -> float:
        """Fraction of the longer side that makes a keyframe, so many frames after the last one."""
        return self.config.flow * max(1.0 / 3.0, 1.0 - since / self.config.patience)

    def add(self, image: TrackingImage, segment: int, matches: Matches | None = None) -> None:
        """One more keyframe. matches: where the last one's points were found in it."""
        whole(self.adding(image, segment, matches))

    def adding(self, image: TrackingImage, segment: int, matches: Matches | None = None) -> Steps[None]:
        """`add`, an edge a step."""
        ones = np.ones(len(image.cells.points))
        earlier = list(self.waiting)
        if segment != self._segment:
            self._segment = segment
            self.diagnosis.begin()
        self.graph.add(Keyframe(image, np.eye(4), ones, 0.0 * ones, segment))
        self.waiting.append(image.index)
        self.diagnosis.waiting(len(self.waiting))
        if matches is not None and earlier:
            yield from self._connecting(image, earlier, matches)

    def abandon(self) -> None:
        """Forgets the waiting keyframes."""
        self._give_up(list(self.waiting))
        self._weak = {}

    def _give_up(self, keyframes: list[int]) -> None:
        """These wait no longer."""
        for index in keyframes:
            self.waiting.remove(index)
            self.graph.remove(index)

    def initialize(self, forced: bool = False, focal: FocalConfig | None = None) -> bool:
        """Solves the waiting keyframes; True where that succeeded: those that the graph still has are part of the map.

        focal: how the graph's focal length is found too; None where it is known.
        """
        return whole(self.initializing(forced, focal))

    def initializing(self, forced: bool = False, focal: FocalConfig | None = None) -> Steps[bool]:
        """`initialize`, a bundle adjustment a step."""
        needed = 3 if forced else self.config.min_keyframes
        if len(self.waiting) < needed:
            return False
        self._tie()
        if apart := self._apart(forced):
            self._give_up(apart)
            others = len(self.waiting)
            self.diagnosis.failed(f"matches do not tie the keyframes: {len(apart)} to none of the {others} others")
            if len(self.waiting) < needed:
                return False
        criteria = self.config.forced if forced else self.config.criteria
        if focal is None:
            start = yield from reconstructing(self.graph, self.waiting, criteria, self.threads)
        else:
            start = yield from reconstructing_with_unknown_focal(
                self.graph, self.waiting, criteria, focal, self._guess, self.threads
            )
        if start.failure:
            self.diagnosis.failed(start.failure)
            if len(self.waiting) >= self.config.max_keyframes:
                self._give_up(self.waiting[:1])
            return False
        for n, index in enumerate(self.waiting):
            keyframe = self.graph.keyframes[index]
            keyframe.cam_from_world, keyframe.inverse_depth = start.cam_from_world[n], start.inverse_depth[n]
            keyframe.information, keyframe.static = start.information[n], start.static[n]
        self.waiting, self._weak = [], {}
        return True

    def _tie(self) -> None:
        """Where too few points are seen by three keyframes, edges of fewer matches tie their scale: better than none,
        and worse than the others where those do."""
        waiting = set(self.waiting)
        self._weak = {pair: matches for pair, matches in self._weak.items() if waiting.issuperset(pair)}
        if not self._weak or share_scale(self.graph, self.waiting):
            return
        for pair, matches in self._weak.items():
            self.graph.connect(*pair, matches, self.config.weak_fraction)
        self._weak = {}

    def _apart(self, forced: bool) -> list[int]:
        """Keyframes that no edges tie to the newest, in the end to the most others: nothing tells their poses."""
        parts = tied_parts(self.graph, self.waiting)
        kept = max(parts, key=len) if forced else parts[-1]
        return [index for index in self.waiting if index not in kept]

    def _connect(self, source: int, to: int, matches: Matches) -> None:
        if not self.graph.connect(source, to, matches, self.config.min_fraction):
            self._weak[source, to] = matches

    def _connecting(self, image: TrackingImage, earlier: list[int], matches: Matches) -> Steps[None]:
        """Edges both ways with the keyframes before, the guesses chained from one to the next."""
        fraction = self.config.min_fraction
        points = image.cells.points.astype(np.float64)
        newest = earlier[-1]
        near = self.graph.keyframes[newest].points.astype(np.float64)
        for index in reversed(earlier[-self.config.recent :]):
            old = self.graph.keyframes[index].image
            forward = matches
            if index != newest:
                link = self.graph.edges.get((index, newest))
                if link is None:
                    continue
                start, seen = old.cells.points.astype(np.float64), link.weight > 0
                hop = link.target.T[seen].astype(np.float64)
                there = propagate(near[matches.alive], (matches.target - near)[matches.alive], hop)
                guess = propagate(start[seen], there - start[seen], start)
                forward, _ = self.matcher.match(old, image, guess, fraction)
                yield
            self._connect(index, image.index, forward)
            if forward.alive.sum() < 30:
                continue
            at = forward.target[forward.alive]
            guess = propagate(at, old.cells.points[forward.alive] - at, points)
            self._connect(image.index, index, self.matcher.match(image, old, guess, fraction)[0])
            yield


__all__ = ["InitializationConfig", "Initializer"]
