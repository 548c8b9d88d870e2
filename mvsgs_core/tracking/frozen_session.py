"""A session that only localizes: each frame is found in a map that stays as it is.

    RELOCALIZING, LOST --- found in the map ---> TRACKING --- a frame can't be followed ---> RELOCALIZING, LOST

A frame is followed from one keyframe of the map; where it has moved away, from the next one that sees what it sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.image import RecentImages, TrackingImage
from mvsgs_core.tracking.keyframe_choice import Tail
from mvsgs_core.tracking.phase import Phase
from mvsgs_core.tracking.publish import Update
from mvsgs_core.tracking.session import Session
from mvsgs_core.trajectory import TrackingState


class FrozenSession(Session):
    def __init__(
        self, config: TrackerConfig, stats: Stats, size: tuple[int, int], intrinsics: np.ndarray, guessed: bool
    ) -> None:
        """As of `Session`; a map must be given before the first frame, see `go_on`."""
        super().__init__(config, stats, size, intrinsics, guessed)
        self._follow_any()

    @classmethod
    def of(cls, session: Session) -> FrozenSession:
        """A session's parts at work here from the next frame on; there must be a map.

        What waits for a keyframe to come is let go, and so are first keyframes that no map was made of.
        """
        frozen = cls.__new__(cls)
        vars(frozen).update(vars(session))
        frozen.waiting.forget()
        frozen._tail = Tail()
        if frozen.phase is Phase.INITIALIZING:
            frozen.initializer.abandon()
            frozen.front_end.reference = None
            frozen.phase = Phase.RELOCALIZING
        frozen._follow_any()
        return frozen

    def thawed(self) -> Session:
        """The parts at work in a session whose map grows, from the next frame on."""
        session = Session.__new__(Session)
        vars(session).update(vars(self))
        session.covisible_keyframes.config = self.config.covisibility
        session.relocalizer.found()  # patience begins anew
        return session

    def _follow_any(self) -> None:
        """Any keyframe of the map may be followed."""
        self.covisible_keyframes.config = replace(self.config.covisibility, min_keyframes=0, min_age=0)

    @property
    def pending(self) -> set[int]:
        return set()

    def last_keyframes(self) -> Iterator[Update]:
        """None ever comes."""
        yield from ()

    def _track(self, frame: TrackingImage, step: Step, record: FrameRecord) -> Update:
        self.phase = Phase.TRACKING
        record.state = TrackingState.TRACKED
        record.follow(self.graph, step.reference, step.matches, step.pose, frame)
        limit = self.covisible_keyframes.limit(step.reference, self.config.keyframe_choice.max_flow)
        if self.choice.moved(step, frame.longer_side, limit):
            self._reuse_keyframe(frame, step)
        if len(self.matcher.used) > RecentImages.LIMIT and self.front_end.reference is not None:
            self.local_map.release_images_but({self.front_end.reference.index})
        return Update(record.state)

    def _relocalize(self, frame: TrackingImage, record: FrameRecord) -> Update:
        self.phase = Phase.RELOCALIZING
        place = self._search_map(frame)
        return Update(record.state) if place is None else self._resume(frame, record, place)


__all__ = ["FrozenSession"]
