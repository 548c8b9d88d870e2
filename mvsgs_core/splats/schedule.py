"""Which keyframe the next iteration trains on: half on a local window, half on all (MVS-GS, section III.C)."""

from __future__ import annotations

import numpy as np


class Schedule:
    """Owed iterations and the order of the keyframes, drawn without replacement, seeded.

    Keyframes are given by their position in the mapper's list. `owed` counts down to 0.
    """

    def __init__(self, window: int, seed: int) -> None:
        self.window = window
        self.owed = 0
        self._random = np.random.default_rng(seed)
        self._local: list[int] = []
        self._all: list[int] = []
        self._turn = 0

    def owe(self, iterations: int) -> None:
        self.owed += iterations
        self._local = []  # the window has moved

    def drop(self) -> int:
        """Forgets what is owed; returns how many iterations that were."""
        dropped, self.owed = self.owed, 0
        return dropped

    def forget(self) -> None:
        """The positions have changed: begins new rounds."""
        self._local, self._all = [], []

    def next(self, count: int) -> int:
        """Position of the next of `count` > 0 keyframes; takes one off what is owed."""
        self.owed = max(0, self.owed - 1)
        self._turn += 1
        if self._turn % 2:
            if not self._local:
                first = max(0, count - self.window)
                self._local = [first + int(i) for i in self._random.permutation(count - first)]
            return self._local.pop()
        return self.next_of_all(count)

    def next_of_all(self, count: int) -> int:
        """Position of the next of `count` > 0 keyframes in a random round through all; owes nothing."""
        if not self._all:
            self._all = [int(i) for i in self._random.permutation(count)]
        return self._all.pop()

    def chance(self, probability: float) -> bool:
        return bool(self._random.random() < probability)
