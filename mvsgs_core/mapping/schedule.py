"""Which image the next iteration trains on: half on a local window, half on all (MVS-GS, section III.C)."""

from __future__ import annotations

from typing import Any

import numpy as np


class Schedule:
    """Pending iterations and the order of the keyframes, drawn without replacement, seeded.

    Keyframes are given by their position in the mapper's list. `pending` counts down to 0, then `beside` does: what
    corrected keyframes, which are owed iterations, may get beside the pending ones until the next keyframe comes.
    `spared` are those that were canceled for want of time.
    """

    def __init__(self, window: int, seed: int) -> None:
        self.window = window
        self.pending = 0
        self.beside = 0
        self.spared = 0
        self.late = 0  # keyframes that got their splats after the stream
        self._random = np.random.default_rng(seed)
        self._local: list[int] = []
        self._all: list[int] = []
        self._turn = 0

    def add_budget(self, iterations: int) -> None:
        """Of a new keyframe. As many may go to what is owed beside them, so that none waits for more than that."""
        self.pending += iterations
        self.beside = iterations
        self._local = []  # the window has moved

    def take_over(self, other: Schedule) -> None:
        """What another part is still to get, which has joined: its keyframes have got positions here."""
        self.pending += other.drop()
        self.beside = max(self.beside, other.beside)
        self.spared += other.spared
        self.late += other.late
        self.reset()

    def drop(self) -> int:
        """Cancels the pending iterations; returns how many they were."""
        dropped, self.pending = self.pending, 0
        return dropped

    def spare(self) -> int:
        """Cancels the pending iterations, which may be made up later; returns how many they were."""
        dropped = self.drop()
        self.spared += dropped
        return dropped

    def reset(self) -> None:
        """The positions have changed: begins new rounds."""
        self._local, self._all = [], []

    def due(self, owed: bool) -> bool:
        """Whether an iteration is to be done before the next keyframe. owed: whether one is to any keyframe."""
        return self.pending > 0 or (owed and self.beside > 0)

    def next(self, count: int, trained: int | None = None, owed: bool = False) -> int | None:
        """Position of the next of `count` > 0 keyframes, None: the one that is owed; takes one off those that are due.

        trained: images in all, the keyframes' first, of which the half on all takes its turns; None: keyframes alone.
        owed: the half on all goes to the keyframe that is owed iterations, and all where none is pending.
        """
        pending = self.pending
        self.pending, self.beside = max(0, pending - 1), self.beside - (pending == 0)
        self._turn += 1
        if owed and (pending == 0 or self._turn % 2 == 0):
            return None
        if self._turn % 2:
            if not self._local:
                first = max(0, count - self.window)
                self._local = [first + int(i) for i in self._random.permutation(count - first)]
            return self._local.pop()
        return self.next_of_all(count if trained is None else trained)

    def next_of_all(self, count: int) -> int:
        """Position of the next of `count` > 0 keyframes in a random round through all; pending stays as it is."""
        if not self._all:
            self._all = [int(i) for i in self._random.permutation(count)]
        return self._all.pop()

    def chance(self, probability: float) -> bool:
        return bool(self._random.random() < probability)

    def state(self) -> dict[str, Any]:
        """All that the next draws depend on, as JSON has it."""
        return {
            "pending": self.pending, "beside": self.beside, "spared": self.spared, "late": self.late,
            "turn": self._turn,
            "local": list(self._local), "all": list(self._all), "random": self._random.bit_generator.state,
        }  # fmt: skip

    def restore(self, state: dict[str, Any], count: int, trained: int) -> None:
        """Goes on where `state()` was taken, with `count` keyframes and so many images in all.

        Raises ValueError for what it never returns.
        """
        self.pending, self.beside, self.spared, self.late, self._turn = (
            _at_least_zero(state.get(name)) for name in ("pending", "beside", "spared", "late", "turn")
        )
        self._local, self._all = _positions(state.get("local"), count), _positions(state.get("all"), trained)
        try:
            self._random.bit_generator.state = state["random"]
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"no state of a random generator: {error}") from error


def _at_least_zero(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{value!r} is no number of iterations")
    return value


def _positions(values: Any, count: int) -> list[int]:
    if not isinstance(values, list) or not all(type(v) is int and 0 <= v < count for v in values):
        raise ValueError(f"positions of keyframes are not below {count}")
    return list(values)
