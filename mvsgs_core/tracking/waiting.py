"""Frames that became no keyframe: they wait for the next one, which poses them again, and then they may go out."""

from __future__ import annotations

from functools import partial

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.between import FramesBetween
from mvsgs_core.tracking.both_sides import BothSides
from mvsgs_core.tracking.frames import FrameRecord
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.matcher import Matcher
from mvsgs_core.tracking.photometer import Photometer
from mvsgs_core.tracking.publish import Publisher
from mvsgs_core.tracking.settling import Settling


class WaitingFrames:
    def __init__(
        self, graph: KeyframeGraph, matcher: Matcher, photometer: Photometer, limit: int, threads: int, stats: Stats
    ) -> None:
        """limit: frames between two keyframes that go out, at most."""
        self._between = FramesBetween(graph, photometer, limit, threads)
        self._both_sides = BothSides(graph, matcher, threads)
        self._stats = stats

    @property
    def indices(self) -> set[int]:
        """Of those whose images are needed until the next keyframe."""
        return self._between.waiting

    def add(self, frame: TrackingImage, record: FrameRecord) -> None:
        """A frame that became no keyframe."""
        self._both_sides.add(frame, record)
        self._between.add(frame, record)

    def end(self) -> None:
        """A keyframe, which is still to be solved; frames that come before that is done wait for the next one."""
        self._between.end()

    def forget_before(self, keyframe: int) -> None:
        """The keyframes before this one are given up: what came between them can be seen from none."""
        self._between.forget_before(keyframe)

    def reopen(self) -> None:
        """It is none after all."""
        self._between.reopen()

    def forget(self) -> None:
        """No keyframe comes that they could be seen from; those between keyframes that are held go on waiting."""
        self._between.forget()
        self._both_sides.forget()

    def settle(self, keyframes: list[int], records: list[FrameRecord], publisher: Publisher) -> Settling:
        """The frames before these keyframes are to be posed; those after them go on waiting. records: of all frames.

        None goes out while these keyframes are held.
        """
        jobs = self._both_sides.settle(keyframes)
        if publisher.held:
            self._between.hold(len(publisher.held))
            return Settling(frozenset(), jobs, tuple, self._stats)
        frames = self._between.close()
        last = partial(self._between.settle, frames, keyframes, records, publisher.published)
        return Settling(frames, jobs, last, self._stats)


__all__ = ["WaitingFrames"]
