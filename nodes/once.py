"""What came already: a stage that was started again in the midst of a run sends some of it once more."""

from __future__ import annotations

from dataclasses import dataclass, field

from msgs import Depth, FusedKeyframe, Keyframe, Poses, Request, TrackedFrame
from mvsgs_core.stats import Stats


@dataclass
class Once:
    """Says of each message whether it is new; counts those that are not.

    Keyframes and frames are known by their index, corrections by their revision, requests by their number: these grow.
    """

    stats: Stats
    keyframes: set[int] = field(default_factory=set)
    corrected: set[int] = field(default_factory=set)  # keyframes that corrections were of
    _frames: set[int] = field(default_factory=set)
    _revision: int = 0
    _request: int = 0

    def keyframe(self, keyframe: Keyframe | Depth | FusedKeyframe) -> bool:
        return self._new(keyframe.index, self.keyframes, "keyframes that came again")

    def frame(self, frame: TrackedFrame) -> bool:
        return self._new(frame.index, self._frames, "frames between keyframes that came again")

    def poses(self, poses: Poses) -> bool:
        if poses.revision <= self._revision:
            self.stats.skip("corrections that came again")
            return False
        self._revision = poses.revision
        self.corrected.update(poses.index.tolist())
        return True

    def request(self, request: Request) -> bool:
        if request.number <= self._request:
            self.stats.skip("requests that came again")
            return False
        self._request = request.number
        return True

    def report_missing(self) -> None:
        """The stream has ended: keyframes that were corrected and never came are lost, which is said."""
        missing = sorted(index for index in self.corrected - self.keyframes if index >= 0)
        if missing:
            self.stats.skip("keyframes that never came", len(missing))
            self.stats.warn(f"{len(missing)} keyframes of the tracker never came, such as {missing[0]}: they were lost")

    def _new(self, index: int, known: set[int], what: str) -> bool:
        if index in known:
            self.stats.skip(what)
            return False
        known.add(index)
        return True


__all__ = ["Once"]
