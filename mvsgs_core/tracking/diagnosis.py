"""Why tracking never started: what was measured of the frames that gave no map, and which of it is most telling."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.features import match_features

KEPT = 1000  # measurements of each kind: more say nothing new


@dataclass
class Measured:
    """A number a frame, of the last KEPT frames; `frames` counts all."""

    frames: int = 0
    values: list[float] = field(default_factory=list)

    def add(self, value: float) -> None:
        self.frames += 1
        self.values = [*self.values[1 - KEPT :], value]

    @property
    def median(self) -> float:
        return float(np.median(self.values)) if self.values else float("nan")


class Diagnosis:
    """Collects what happens to frames before a start. Displacements are fractions of the longer side."""

    def __init__(self, lost_fraction: float, min_texture: float) -> None:
        """As of FrontEndConfig and TrackerConfig."""
        self.lost_fraction = lost_fraction
        self.min_texture = min_texture
        self.begin()

    def begin(self) -> None:
        """A segment: what kept one before from starting is no reason."""
        self.blank = Measured()  # frames without texture: fraction of the cells that are textured
        self.lost = Measured()  # frames that could not be followed: fraction of the points that survived
        self.jumped = Measured()  # of these: displacement by features, where enough of them agree
        self.followed = Measured()  # frames that were: displacement since the last keyframe
        self.max_waiting = 0  # keyframes that ever waited for a start
        self.attempts: dict[str, tuple[int, str]] = {}  # starts that failed: how often, and what the last one measured

    def no_texture(self, frame: TrackingImage) -> None:
        self.blank.add(float(frame.cells.textured.mean()))

    def saw(self, reference: TrackingImage, frame: TrackingImage, step: Step, lost: bool) -> None:
        """A frame after the first, and whether the reference's points could not be found in it."""
        if not lost:
            self.followed.add(step.flow / frame.longer_side)
        elif frame.cells.textured.mean() < self.min_texture:
            self.no_texture(frame)
        else:
            self.lost.add(step.fraction)
            here, there = match_features(reference, frame)
            if len(here):
                self.jumped.add(float(np.median(np.linalg.norm(there - here, axis=1))) / frame.longer_side)

    def failed(self, failure: str) -> None:
        """A start was tried. failure: of a Reconstruction."""
        kind = failure.partition(":")[0]
        self.attempts[kind] = (self.attempts.get(kind, (0, ""))[0] + 1, failure)

    def waiting(self, keyframes: int) -> None:
        """So many keyframes wait for a start."""
        self.max_waiting = max(self.max_waiting, keyframes)

    def reason(self, needed: int) -> str:
        """In words. needed: keyframes that a start takes."""
        frames = self.blank.frames + self.lost.frames + self.followed.frames
        if frames == 0:
            return "too little motion: there was a single frame"
        if self.blank.frames > frames / 2:
            return (
                f"no texture: {self.blank.frames} of {frames} frames have hardly any, "
                f"{100 * self.blank.median:.1f} % of the image in the median "
                f"({100 * self.min_texture:.0f} % are needed)"
            )
        if self.lost.frames > frames / 4:
            jump = f"by {100 * self.jumped.median:.0f} % of the longer side, " if self.jumped.frames else ""
            found = f"{self.jumped.frames} of them by features" if self.jumped.frames else "none of them by features"
            return (
                f"steps too wide: {self.lost.frames} of {frames} frames could not be followed from the one before "
                f"(median displacement {jump}{found}; {100 * self.lost.median:.0f} % of the matches survive, "
                f"{100 * self.lost_fraction:.0f} % are needed): more frames a second, or smaller steps, "
                "help; photographs with wide steps, in any order, are for tracker=photographs"
            )
        if self.attempts:
            kind = max(self.attempts, key=lambda k: self.attempts[k][0])
            times, text = self.attempts[kind]
            return f"{text} ({times} of {sum(n for n, _ in self.attempts.values())} attempts)"
        return (
            f"too little motion: the image moved by {100 * self.followed.median:.1f} % of its longer side in the "
            f"median ({100 * max(self.followed.values):.1f} % at most) since the last keyframe, over {frames} frames: "
            f"{self.max_waiting} of {needed} keyframes that a start takes"
        )


__all__ = ["Diagnosis", "Measured"]
