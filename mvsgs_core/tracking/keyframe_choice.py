"""Which frames become keyframes: those that moved enough; held-out ones only where the next would be too late.

A held-out frame (held_out.py) is to be scored against a map that never saw it, so the next frame is taken in its place.
Where the camera moves so fast that the next one may be lost, or that most frames become keyframes anyway, it stays.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mvsgs_core.held_out import is_held_out
from mvsgs_core.setting_ranges import at_least, within
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.keyframe_spacing import KeyframeSpacing

DOUBT = 0.5  # of the flow that makes a keyframe: where few matches agree with the pose, so much is enough
LATE_FLOW = 2.0  # of the flow that makes a keyframe: the next frame may have moved by so much, and not further
LATE_FRACTION = 0.8  # of the fraction of points below which a keyframe is made: the next frame must still find so many
LAST = 0.25  # of the flow that makes a keyframe: what is enough at the end of the stream

HELD_OUT = "keyframes that were to be held out"


@dataclass(frozen=True)
class KeyframeChoiceConfig:
    max_flow: float = 0.05  # of the longer side: a larger median flow since the last keyframe makes another
    min_fraction: float = 0.5  # of the textured points: fewer found make a keyframe
    # of the matches, within 2 pixels of one pose: fewer make a keyframe after half the flow, well before the frame is
    # lost (front_end.lost_inliers). Beside what is near the camera, points are found to the end and agree no more.
    min_inliers: float = 0.75

    def __post_init__(self) -> None:
        at_least(self, max_flow=0)
        within(self, min_fraction=(0, 1), min_inliers=(0, 1))


class KeyframeChoice:
    """Follows how fast the frames move away from their reference keyframe."""

    def __init__(self, config: KeyframeChoiceConfig, spacing: KeyframeSpacing | None = None) -> None:
        """spacing: of a live stream; None: keyframes are as far apart as configured."""
        self.config, self.spacing = config, spacing
        self._before = (-1, 0.0, 1.0)  # reference of the last frame, its flow in pixels, its fraction of points found

    @property
    def max_flow(self) -> float:
        """As a fraction of the longer side, now."""
        return self.config.max_flow * self._factor

    @property
    def _factor(self) -> float:
        return 1.0 if self.spacing is None else self.spacing.factor

    def moved(self, step: Step, side: int, limit: float) -> bool:
        """Whether the image has changed enough since the reference.

        side: pixels of its longer side. limit: largest flow, as a fraction of it.
        """
        if step.flow > limit * side or step.fraction < self.config.min_fraction:
            return True
        doubted = step.localization is not None and step.localization.inliers < self.config.min_inliers
        return doubted and step.flow > DOUBT * limit / self._factor * side  # doubt waits for no wider spacing

    def saw(self, step: Step) -> None:
        """A frame that becomes no keyframe, however much it moved."""
        if self.spacing is not None:
            self.spacing.look()
        self._before = (step.reference, step.flow, step.fraction)

    def wants(self, index: int, step: Step, side: int, limit: float) -> bool:
        """Whether frame `index` becomes a keyframe. side, limit: as of `moved`."""
        known, flow, fraction = self._before
        flow, fraction = (flow, fraction) if known == step.reference else (0.0, 1.0)
        self.saw(step)
        wanted = self.moved(step, side, limit)
        if wanted and is_held_out(index):
            wanted = self._late(2.0 * step.flow - flow, 2.0 * step.fraction - fraction, side, limit)
        if wanted and self.spacing is not None:
            self.spacing.made(step.flow, self.config.max_flow * side)
        return wanted

    def is_late(self, step: Step, side: int, limit: float) -> bool:
        """Whether the frames after this one may be lost without a keyframe. side, limit: as of `moved`."""
        return self._late(step.flow, step.fraction, side, limit)

    def _late(self, flow: float, fraction: float, side: int, limit: float) -> bool:
        return flow > LATE_FLOW * limit * side or fraction < LATE_FRACTION * self.config.min_fraction

    def shows_new(self, step: Step, side: int) -> bool:
        """Whether the last frame of a stream shows enough that its reference does not."""
        lost = 1.0 - LAST * (1.0 - self.config.min_fraction)
        return step.flow > LAST * self.config.max_flow * side or step.fraction < lost


class Tail:
    """The last two frames since the last keyframe, of those that were tracked: the stream may end with one of them."""

    def __init__(self) -> None:
        self._frames: dict[int, tuple[TrackingImage, Step]] = {}

    @property
    def indices(self) -> set[int]:
        return set(self._frames)

    def add(self, frame: TrackingImage, step: Step) -> None:
        self._frames = dict(sorted(self._frames.items())[-1:]) | {frame.index: (frame, step)}

    def newest_after(self, index: int) -> tuple[TrackingImage, Step] | None:
        """The newer one, where it came after the frame `index`."""
        newest_one = max(self._frames, default=-1)
        return self._frames[newest_one] if newest_one > index else None

    def last(self, choice: KeyframeChoice) -> tuple[TrackingImage, Step] | None:
        """The one that is to be a keyframe at the end of the stream; None where neither shows enough."""
        shown = {i: (f, s) for i, (f, s) in self._frames.items() if choice.shows_new(s, f.longer_side)}
        last = newest(shown)
        return None if last is None else shown[last]


def newest(indices: Iterable[int]) -> int | None:
    """The newest frame that is not held out, else the newest; None of none."""
    order = sorted(indices, reverse=True)
    return next((index for index in order if not is_held_out(index)), order[0] if order else None)


__all__ = ["HELD_OUT", "KeyframeChoice", "KeyframeChoiceConfig", "Tail", "newest"]
