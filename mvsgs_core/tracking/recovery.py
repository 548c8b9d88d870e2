"""After a loss: the map is searched for the camera; in the end, frames without a pose get one where they can."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvsgs_core.tracking.frames import FrameRecord, State, compact
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matcher import Matcher
from mvsgs_core.tracking.retrieval import Retrieval
from mvsgs_core.tracking.sighting import Sighting, SightingCriteria, sight


@dataclass(frozen=True)
class RecoveryConfig:
    candidates: int = 3  # keyframes that a lost frame is compared with
    patience: int = 6  # lost frames in a row after which a new segment begins
    kept: int = 400  # images of frames without a pose, for another try in the end
    criteria: SightingCriteria = field(default_factory=SightingCriteria)


class Recovery:
    def __init__(
        self,
        graph: KeyframeGraph,
        matcher: Matcher,
        retrieval: Retrieval,
        config: RecoveryConfig,
        front_end: FrontEndConfig,
    ) -> None:
        self.graph = graph
        self.matcher = matcher
        self.retrieval = retrieval
        self.config = config
        self.front_end_config = front_end
        self.in_a_row = 0
        self._kept: dict[int, TrackingImage] = {}

    @property
    def hopeless(self) -> bool:
        """Lost for so long that a new segment should begin."""
        return self.in_a_row >= self.config.patience

    def found_again(self) -> None:
        self.in_a_row = 0

    def keep(self, frame: TrackingImage) -> None:
        """The image of a frame that has no pose (yet)."""
        if len(self._kept) < self.config.kept:
            self._kept[frame.index] = frame

    def lost(self, frame: TrackingImage) -> Sighting | None:
        """One more lost frame: where it was found, if it was."""
        self.in_a_row += 1
        return self.relocalize(frame)

    def relocalize(self, frame: TrackingImage) -> Sighting | None:
        """The keyframe that looks most alike and verifies."""
        candidates = self.retrieval.query(frame.features()[1], self.config.candidates, set())
        for index in candidates:
            if index not in self.graph.keyframes:
                continue
            found = sight(self.graph, self.matcher, index, frame, self.config.criteria)
            if found is not None:
                return found
        return None

    def fill_in(self, records: list[FrameRecord]) -> int:
        """Frames without a pose, followed backward from the next keyframe and forward from the one before.

        Returns how many were found.
        """
        found = 0
        keyframes = sorted(self.graph.keyframes)
        for forward in (False, True):
            run: list[FrameRecord] = []
            for record in records if forward else reversed(records):
                if self._has_pose(record):
                    run = []
                    continue
                run.append(record)
                image = self._kept.get(record.index)
                around = [k for k in keyframes if (k < record.index) == forward and k != record.index]
                if image is None or not around:
                    continue
                if len(run) == 1:
                    follower = FrontEnd(self.graph, self.matcher, self.front_end_config, 1)
                    start = self.graph.keyframes[max(around) if forward else min(around)]
                    follower.refer_to(start.image)
                    follower.pose = start.cam_from_world
                assert follower.reference is not None
                step = follower.follow(image, True)
                if step.still or follower.is_lost(step) or step.localization is None:
                    continue
                record.reference, record.matches = follower.reference.index, compact(step.matches)
                record.cam_from_reference = follower.cam_from_reference(step)
                record.state, record.same_as = State.TRACKED, None
                found += 1
        return found

    def _has_pose(self, record: FrameRecord) -> bool:
        if record.index in self.graph.keyframes or record.same_as is not None:
            return True
        return record.state != State.LOST and record.reference in self.graph.keyframes


__all__ = ["Recovery", "RecoveryConfig"]
