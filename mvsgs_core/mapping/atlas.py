"""The maps of one stream: a mapper for each segment, the parts between which tracking was lost, and their joins.

Segments share no frame of reference. Where a loop joined two, so are their maps; of those that stay apart at the end
of the stream, the one with the most keyframes is refined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.camera import MAX_READOUT_TIME, is_readout_time
from mvsgs_core.mapping.between import FrameBetween, FramesBetween
from mvsgs_core.mapping.blocks.refinement import refined_in_blocks
from mvsgs_core.mapping.checkpoints.state import copy_of
from mvsgs_core.mapping.keyframe_checks import NO_POSE, is_pose
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats


@dataclass
class Atlas:
    """The mappers of a stream's segments, which share log and corrections, and how far the stream has come.

    `add` and `correct` as the messages come, `step` while any iteration is pending, `finish` at the stream's end, then
    `refine` until it is done.
    """

    current: OnlineMapper  # the one that is gone on with
    parts: dict[int, OnlineMapper] = field(default_factory=dict)  # by segment
    segment_of: dict[int, int] = field(default_factory=dict)  # by keyframe, as the newest Poses that named it say
    newest_view: int = -1  # frame index of the newest keyframe that came
    stream_seconds: float = 0.0  # timestamp of it
    revision: int = -1  # of the newest Poses
    stream_ended: bool = False
    between: FramesBetween = field(default_factory=FramesBetween)  # frames that are no keyframes, on their way
    refined: int = 0  # iterations of the final refinement that are done
    _in_blocks: Iterator[int] | None = None  # what is left of it in blocks, where the map is refined so

    @property
    def largest(self) -> OnlineMapper:
        """The part with the most keyframes, of those that the stream has seen if it has; the current one of none."""

        def keyframes(part: OnlineMapper) -> tuple[bool, int]:
            return _seen(part), len(part.views)

        return max(self.parts.values(), key=keyframes, default=self.current)

    @property
    def segments(self) -> set[int]:
        """Of the current part: one, or those whose first keyframe is still to come there."""
        return {segment for segment, part in self.parts.items() if part is self.current}

    def add(self, keyframe: RGBDKeyframe, segment: int, halvings: int = 0) -> TrainingView | None:
        """Maps a new keyframe of that segment; returns what is trained on, None where it was refused.

        halvings: as in `OnlineMapper.add_keyframe`.
        Where the map was being refined already, that begins anew after it.
        """
        # sent on its way before its segment was joined: by keyframe and not by number, as the pose is corrected so, too
        self.enter(self.segment_of.get(keyframe.index, segment))
        self.came(keyframe.index, keyframe.timestamp)
        known = len(self.current.views)
        self.current.add_keyframe(keyframe, halvings)
        self.take_between()
        return self.current.views[-1] if len(self.current.views) > known else None

    def add_between(self, given: FrameBetween) -> None:
        """Takes in a frame to train on, as soon as its keyframe is mapped and another one is, or the stream ends."""
        self.between.wait(given, self.current.log)

    def take_between(self) -> None:
        """Those whose keyframes are mapped."""
        for part in self.parts.values():
            for given in self.between.take(part.keyframes):
                part.add_between(given)

    def step(self) -> bool:
        """One pending iteration of the current part; False when none is."""
        return self.current.step()

    def finish(self) -> None:
        """The stream has ended: of parts that stayed apart, the largest is gone on with.

        What its corrected keyframes are still owed may take as many iterations as a short refinement does, by `step`.
        """
        self.take_between()
        if not self.stream_ended:  # or this was cut off after it: what was owed has had its iterations
            self.largest.end()
        self.stream_ended = True
        parts, log = [part for part in self.parts.values() if part.views], self.current.log
        log.values["segments_apart"] = max(0, len(parts) - 1)  # beside the map that is shown
        self.current = self.largest
        if len(parts) < 2:
            return
        total = sum(len(part.views) for part in parts)
        known = [part for part in parts if part.views and part.views[0].index < 0]
        lost = "tracking was lost"
        if known and not any(map(_seen, known)):
            lost = "the camera was not found in the map that the run began on"
        log.warn(
            f"{lost}: the map shows the largest of {len(parts)} parts, {len(self.current.views)} of {total} keyframes"
        )

    def begin_late(self) -> bool:
        """The first splats of a keyframe that got none when it came, as in `OnlineMapper`; False when none is left."""
        return self.current.begin_late()

    def make_up(self, splats: bool = True, rate: float | None = None) -> bool:
        """A piece of what a live stream left no time for, as in `OnlineMapper`; False when nothing is left.

        After the stream as many iterations as a short refinement has at most: one that was long would be waited for as
        long again.
        """
        limit = self.current.config.refinement_of(0) if self.stream_ended else None
        return self.current.make_up(limit, splats, rate)

    def refine(self) -> bool:
        """A piece of the final refinement, an iteration or a wait for one elsewhere; False when it is done.

        In blocks the map stays as it is until all are done: who goes on from it begins the refinement anew. The last
        iterations, over the whole map, follow as any others.
        """
        total = self.current.refinement
        if self.refined >= total:
            return False
        if self.refined == 0 and self._in_blocks is None:
            self._in_blocks = refined_in_blocks(self.current, total)
        if self._in_blocks is None:
            self.current.refine(self.refined, total)
            self.refined += 1
        elif done := next(self._in_blocks):
            self._in_blocks, self.refined = None, done
        return True

    def correct(
        self, index: np.ndarray, world_from_cam: np.ndarray, scale: np.ndarray, segment: np.ndarray | None = None,
        exposure: np.ndarray | None = None, vignetting: np.ndarray | None = None, velocity: np.ndarray | None = None,
        readout_time: float = 0.0, reads_columns: bool = False,
    ) -> None:  # fmt: skip
        """Corrected poses as in `OnlineMapper.correct`, for each part's keyframes; what is no pose is counted once.

        segment (K,): to which their keyframes belong now; maps of segments that became one are joined. exposure
        (K, 3, 4), vignetting (3,): as in `ImageFormation.take`. velocity (K, 6), readout_time,
        reads_columns: as in `OnlineMapper.move`.
        """
        usable = np.array([is_pose(pose, s) for pose, s in zip(world_from_cam, scale.tolist())], bool)
        if not usable.all():
            self.current.log.refuse("poses", int((~usable).sum()), NO_POSE)
        if velocity is not None and not is_readout_time(readout_time):
            self.current.log.refuse(
                "readout times", 1, f"a readout time of more than {MAX_READOUT_TIME:g} s was refused"
            )
            velocity = None
        for part in self.parts.values() or [self.current]:
            part.correct(index[usable], world_from_cam[usable], scale[usable])
            if velocity is not None:
                part.move(index[usable], velocity[usable], readout_time, reads_columns)
        if self.current.config.training.exposure and not (exposure is None and vignetting is None):
            self.current.photometry.take(index.tolist(), exposure, vignetting, self.current.log)
            for part in self.parts.values() or [self.current]:
                part.expose()
        if segment is not None:
            self.segment_of.update(zip(index.tolist(), segment.tolist()))
            self.join()

    def enter(self, segment: int) -> None:
        """Goes on with the map of this part of the stream, or begins it."""
        if not self.parts:
            self.parts[segment] = self.current
        if segment not in self.parts:
            while not self.current.config.realtime and self.current.step():  # what is pending of the part before
                pass
            before = self.current
            self.parts[segment] = OnlineMapper(
                before.config, before.log, before.corrections, photometry=before.photometry
            )
        if self.parts[segment] is not self.current:
            self.current.keyframes.rest()
        self.current = self.parts[segment]

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
        """How far the stream has come: the newest keyframe and its timestamp."""
        self.newest_view = max(self.newest_view, index)
        self.stream_seconds = seconds if math.isfinite(seconds) else self.stream_seconds
        self.stream_ended, self.refined, self._in_blocks = False, 0, None
        for part in self.parts.values():
            part.trainer.rate = 1.0

    def frozen(self) -> Atlas:
        """A copy that shares nothing that changes, on the CPU. Raises ValueError in the middle of a change."""
        log, corrections, photometry = Stats(), dict(self.current.corrections), self.current.photometry.copy()
        log.include(self.current.log)
        parts = {segment: copy_of(part, log, corrections, photometry) for segment, part in self.parts.items()}
        current = next((parts[s] for s, part in self.parts.items() if part is self.current), None)
        return Atlas(
            current or OnlineMapper(self.current.config, log, corrections, photometry=photometry), parts,
            dict(self.segment_of), self.newest_view, self.stream_seconds, self.revision, self.stream_ended,
            FramesBetween(taken=set(self.between.taken)), self.refined,
        )  # fmt: skip


def _seen(part: OnlineMapper) -> bool:
    """Whether the stream has given the part a keyframe: those of a map that it began on are numbered below 0."""
    return bool(part.views) and part.views[-1].index >= 0
