"""After a loss: the map is searched for the camera; in the end, frames without a pose get one where they can."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch, verify_place
from mvsgs_core.tracking.places.retrieval import Retrieval
from mvsgs_core.tracking.pose_criteria import PoseCriteria, verified


@dataclass(frozen=True)
class RecoveryConfig:
    candidates: int = 3  # keyframes that a lost frame is compared with
    patience: int = 6  # lost frames in a row after which a new segment begins
    max_images: int = 400  # images of frames without a pose, for another try in the end; the oldest goes first
    criteria: PoseCriteria = field(default_factory=PoseCriteria)


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
        self._kept[frame.index] = frame.bare()
        if len(self._kept) > self.config.max_images:
            del self._kept[next(iter(self._kept))]

    def lost(self, frame: TrackingImage) -> PlaceMatch | None:
        """One more lost frame: where it was found, if it was."""
        self.in_a_row += 1
        return self.relocalize(frame)

    def relocalize(self, frame: TrackingImage) -> PlaceMatch | None:
        """The keyframe that looks most alike and verifies."""
        candidates = self.retrieval.query(frame.features()[1], self.config.candidates, set())
        for index in candidates:
            if index not in self.graph.keyframes:
                continue
            found = verify_place(self.graph, self.matcher, index, frame, self.config.criteria)
            if found is not None:
                return found
        return None

    def fill_in(self, records: list[FrameRecord]) -> int:
        """Frames without a pose, followed backward from the next keyframe and forward from the one before.

        Each is verified; returns how many were found.
        """
        found = 0
        for forward in (False, True):
            start: int | None = None  # the keyframe that was passed last
            run: list[FrameRecord] = []
            for record in [*(records if forward else reversed(records)), None]:
                if record is not None and (record.same_as is not None or not self._has_pose(record)):
                    run += [] if record.same_as is not None else [record]  # it stands where its model stands
                    continue
                if run and start is not None:
                    found += self._follow(start, run)
                run = []
                if record is not None and record.index in self.graph.keyframes:
                    start = record.index
        return found

    def _follow(self, start: int, run: Iterable[FrameRecord]) -> int:
        """One run of frames without a pose, from the keyframe at its side; returns how many were found."""
        follower = FrontEnd(self.graph, self.matcher, self.front_end_config, 1)
        follower.refer_to(self.graph.keyframes[start].image)
        follower.pose = self.graph.keyframes[start].cam_from_world
        found = 0
        for record in run:
            image = self._kept.get(record.index)
            if image is None:
                continue
            step = follower.follow(image, True)
            if follower.is_lost(step) or step.localization is None:
                continue
            if verified(self.graph, start, step.matches, step.localization, self.config.criteria):
                record.follow(self.graph, start, step.matches, step.localization.cam_from_world)
                found += 1
            image.release()
        return found

    def _has_pose(self, record: FrameRecord) -> bool:
        return record.index in self.graph.keyframes or record.reference is not None


__all__ = ["Recovery", "RecoveryConfig"]
