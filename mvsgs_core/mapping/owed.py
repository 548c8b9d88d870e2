"""Keyframes that are owed iterations since a correction moved them, in the order in which they get them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable

from mvsgs_core.mapping.keyframes import TrainingView


class Owed:
    """Those with the fewest visits since their correction go first, of equal ones the older.

    A heap that is brought up to date where it is looked at: O(log K) an iteration, O(K) a correction.
    """

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, TrainingView]] = []  # visits when it was put here, index

    def __len__(self) -> int:
        """At most so many are owed something."""
        return len(self._heap)

    def count(self, views: Iterable[TrainingView]) -> None:
        """Of these keyframes, some of which were corrected."""
        self._heap = [(view.visits_here, view.index, view) for view in views if not math.isnan(view.loss_before)]
        heapq.heapify(self._heap)

    def first(self, limit: int) -> TrainingView | None:
        """The next, see `TrainingView.owed`; None: no keyframe is owed anything."""
        while self._heap:
            visits, index, view = self._heap[0]
            if not (view.has_image and view.owed(limit)):
                heapq.heappop(self._heap)
            elif view.visits_here != visits:
                heapq.heapreplace(self._heap, (view.visits_here, index, view))
            else:
                return view
        return None
