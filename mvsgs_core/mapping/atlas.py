"""The mapping of one stream: a mapper for each part between which tracking was lost, and how far it has come."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.mapping.checkpoints.state import copy_of
from mvsgs_core.mapping.keyframe_checks import NO_POSE, is_pose
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats


@dataclass
class Atlas:
    """The mappers of a stream's segments, which share log and corrections, and how far the stream has come."""

    current: OnlineMapper  # the one that is gone on with
    parts: dict[int, OnlineMapper] = field(default_factory=dict)  # by segment
    segment_of: dict[int, int] = field(default_factory=dict)  # by keyframe, as the newest Poses that named it say
    newest_view: int = -1  # frame index of the newest keyframe that came
    stream_seconds: float = 0.0  # timestamp of it
    revision: int = -1  # of the newest Poses
    stream_ended: bool = False
    refined: int = 0  # iterations of the final refinement that are done

    @property
    def largest(self) -> OnlineMapper:
        """The part with the most keyframes; the current one where there is none yet."""
        return max(self.parts.values(), key=lambda part: len(part.views), default=self.current)

    def enter(self, segment: int) -> None:
        """Goes on with the map of this part of the stream, or begins it."""
        if not self.parts:
            self.parts[segment] = self.current
        if segment not in self.parts:
            while self.current.step():  # what is pending of the part before
                pass
            before = self.current
            self.parts[segment] = OnlineMapper(before.config, before.log, before.corrections)
        self.current = self.parts[segment]

    def correct(self, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray) -> None:
        """Corrected poses as in `OnlineMapper.correct`, for each part's keyframes; what is no pose is counted once."""
        usable = np.array([is_pose(pose, s) for pose, s in zip(world_from_cam, scale.tolist())], bool)
        if not usable.all():
            self.current.log.refuse("poses", int((~usable).sum()), NO_POSE)
        for part in self.parts.values() or [self.current]:
            part.correct(index[usable], world_from_cam[usable], scale[usable])

    def join(self) -> None:
        """Joins the maps of segments whose keyframes now belong to another one; the tracker joins whole segments."""
        for old, part in list(self.parts.items()):
            new = {self.segment_of.get(view.index, old) for view in part.views} - {old}
            if not new:
                continue
            del self.parts[old]
            joined = self.parts.setdefault(new.pop(), part)  # nothing of the other one may have come yet
            if joined is part:
                continue
            joined.join(part)
            if self.current is part:
                self.current = joined
            self.current.log.count("segments_joined")

    def came(self, index: int, seconds: float) -> None:
        """A new keyframe; where the map was being refined already, that begins anew after it."""
        self.newest_view = max(self.newest_view, index)
        self.stream_seconds = seconds if math.isfinite(seconds) else self.stream_seconds
        self.stream_ended, self.refined = False, 0
        for part in self.parts.values():
            part.trainer.rate = 1.0

    def frozen(self) -> Atlas:
        """A copy that shares nothing that changes, on the CPU. Raises ValueError in the middle of a change."""
        log, corrections = Stats(), dict(self.current.corrections)
        log.include(self.current.log)
        parts = {segment: copy_of(part, log, corrections) for segment, part in self.parts.items()}
        current = next((parts[s] for s, part in self.parts.items() if part is self.current), None)
        return Atlas(
            current or OnlineMapper(self.current.config, log, corrections), parts, dict(self.segment_of),
            self.newest_view, self.stream_seconds, self.revision, self.stream_ended, self.refined,
        )  # fmt: skip
