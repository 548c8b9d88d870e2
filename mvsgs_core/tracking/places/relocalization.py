"""A lost camera is looked for in the map: the keyframes that look most alike, each verified by its geometry."""

from __future__ import annotations

from dataclasses import dataclass, field

from mvsgs_core.setting_ranges import at_least
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch, verify_place
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.places.retrieval import Retrieval


@dataclass(frozen=True)
class RelocalizationConfig:
    max_candidates: int = 3  # keyframes that a lost frame is compared with
    patience: int = 6  # lost frames in a row after which a new segment begins
    criteria: PoseCriteria = field(default_factory=PoseCriteria)

    def __post_init__(self) -> None:
        at_least(self, max_candidates=0, patience=1)


@dataclass
class Relocalizer:
    graph: KeyframeGraph
    matcher: Matcher
    retrieval: Retrieval  # of the keyframes that may be found; some may have left the graph
    config: RelocalizationConfig
    lost_frames: int = field(default=0, init=False)  # in a row

    @property
    def hopeless(self) -> bool:
        """Lost for so long that a new segment should begin."""
        return self.lost_frames >= self.config.patience

    def found(self) -> None:
        """The camera is followed again."""
        self.lost_frames = 0

    def lost(self, frame: TrackingImage) -> PlaceMatch | None:
        """One more lost frame: where it was found, if it was."""
        self.lost_frames += 1
        return self.relocalize(frame)

    def relocalize(self, frame: TrackingImage) -> PlaceMatch | None:
        """The keyframe that looks most alike and verifies."""
        for index in self.retrieval.query(frame.features()[1], self.config.max_candidates, set()):
            if index in self.graph.keyframes:
                found = verify_place(self.graph, self.matcher, index, frame, self.config.criteria)
                if found is not None:
                    return found
        return None


__all__ = ["RelocalizationConfig", "Relocalizer"]
