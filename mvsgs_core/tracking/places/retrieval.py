"""Keyframe retrieval by appearance: an inverted index of binary words, each some chosen bits of an ORB descriptor."""

from __future__ import annotations

import numpy as np

TABLES = 4
BITS = 14  # a word; descriptors of the same corner share the word of some table


class Retrieval:
    """Grows by one keyframe at a time; asks which keyframes share rare words with an image."""

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._bits = np.stack([random.choice(256, BITS, replace=False) for _ in range(TABLES)])
        self._postings: dict[int, list[int]] = {}
        self._keyframes = 0

    def add(self, index: int, descriptors: np.ndarray) -> None:
        """descriptors: (N, 32) uint8."""
        self._keyframes += 1
        for word in np.unique(self._words(descriptors)):
            self._postings.setdefault(int(word), []).append(index)

    def query(self, descriptors: np.ndarray, count: int, exclude: set[int], usual: set[int] | None = None) -> list[int]:
        """The keyframes outside `exclude` that look most alike, best first.

        usual: keyframes that are known to see the same: those that look less than half as much like it are no match.
        """
        scores: dict[int, float] = {}
        for word in np.unique(self._words(descriptors)):
            postings = self._postings.get(int(word), ())
            if not postings:
                continue
            rarity = float(np.log(1.0 + self._keyframes / len(postings)))
            for index in postings:
                scores[index] = scores.get(index, 0.0) + rarity
        min_score = 0.5 * max((scores.get(index, 0.0) for index in usual or ()), default=0.0)
        good = [index for index in scores if index not in exclude and scores[index] >= min_score]
        return sorted(good, key=lambda index: (-scores[index], index))[:count]

    def _words(self, descriptors: np.ndarray) -> np.ndarray:
        if len(descriptors) == 0:
            return np.zeros(0, np.int64)
        bits = np.unpackbits(descriptors, axis=1).astype(np.int64)
        powers = 1 << np.arange(BITS, dtype=np.int64)
        return np.concatenate([bits[:, chosen] @ powers + (t << BITS) for t, chosen in enumerate(self._bits)])


__all__ = ["Retrieval"]
