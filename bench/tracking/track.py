"""The tracker on a whole sequence."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mvsgs_core.datasets import Item
from mvsgs_core.tracking.tracker import Tracker


@dataclass(frozen=True)
class Tracked:
    """A tracker that has seen the end of its stream."""

    tracker: Tracker
    seconds: float  # of the processor, of all frames
    end: float  # of the processor, of what follows the last one


def track(items: Iterable[Item], tracker: Tracker | None = None, seen: Callable[[Item], None] | None = None) -> Tracked:
    """All frames and the stream's end. tracker: None: the default one; seen: called after each frame."""
    tracker = tracker or Tracker(clock=time.process_time)
    seconds = 0.0
    for item in items:
        start = time.process_time()
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics, item.intrinsics_guessed, mask=item.mask)
        seconds += time.process_time() - start
        if seen is not None:
            seen(item)
    start = time.process_time()
    for _ in tracker.finish():
        pass
    return Tracked(tracker, seconds, time.process_time() - start)
