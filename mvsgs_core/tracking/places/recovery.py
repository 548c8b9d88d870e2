"""Frames without a pose get one at the end of the stream where they can: followed from the keyframes beside them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from mvsgs_core.setting_ranges import at_least
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.front_end import FrontEnd, FrontEndConfig
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.steps import Steps, whole


@dataclass(frozen=True)
class RecoveryConfig:
    max_images: int = 400  # of frames without a pose, kept for another try in the end; the oldest goes first
    criteria: PoseCriteria = field(default_factory=PoseCriteria)

    def __post_init__(self) -> None:
        at_least(self, max_images=0)


@dataclass
class Recovery:
    graph: KeyframeGraph
    matcher: Matcher
    config: RecoveryConfig
    front_end: FrontEndConfig  # how they are followed
    _images: dict[int, TrackingImage] = field(default_factory=dict, init=False)

    def keep(self, frame: TrackingImage) -> None:
        """The image of a frame that has no pose (yet)."""
        self._images[frame.index] = frame.bare()
        if len(self._images) > self.config.max_images:
            del self._images[next(iter(self._images))]

    def fill_in(self, records: list[FrameRecord]) -> int:
        """Frames without a pose, followed backward from the next keyframe and forward from the one before.

        Each pose that is found meets the criteria; returns how many were found.
        """
        return whole(self.filling_in(records))

    def filling_in(self, records: list[FrameRecord]) -> Steps[int]:
        """`fill_in`, a frame a step."""
        found = 0
        for forward in (False, True):
            start: int | None = None  # the keyframe that was passed last
            run: list[FrameRecord] = []
            for record in [*(records if forward else reversed(records)), None]:
                if record is not None and record.same_as is not None:
                    continue  # it stands where its model stands
                if record is not None and not self._has_pose(record):
                    run.append(record)
                    continue
                if run and start is not None:
                    found += yield from self._follow(start, run)
                run = []
                if record is not None and record.index in self.graph.keyframes:
                    start = record.index
        return found

    def _follow(self, start: int, run: Iterable[FrameRecord]) -> Steps[int]:
        """One run of frames without a pose, from the keyframe at its side; returns how many were found."""
        follower, reference = FrontEnd(self.graph, self.matcher, self.front_end, 1), self.graph.keyframes[start].image
        follower.refer_to(reference)
        found = 0
        for record in run:
            image = self._images.get(record.index)
            if image is None:
                continue
            step = follower.follow(image, with_pose=True)
            pose = None if follower.is_lost(step) else step.localization
            if pose is not None and self.config.criteria.accept(self.graph, start, step.matches, pose):
                record.follow(self.graph, start, step.matches, pose.cam_from_world, image)
                found += 1
            image.release()
            yield
        reference.release()
        return found

    def _has_pose(self, record: FrameRecord) -> bool:
        return record.index in self.graph.keyframes or record.reference is not None


__all__ = ["Recovery", "RecoveryConfig"]
