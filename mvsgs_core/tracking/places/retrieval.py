"""Keyframe retrieval by appearance: an inverted index of binary words, each some chosen bits of an ORB descriptor."""

from __future__ import annotations

from array import array
from collections import defaultdict
from functools import partial

import numpy as np

TABLES = 4
BITS = 14  # a word, of two bytes; descriptors of the same corner share the word of some table
MOST_POSTINGS = 600_000  # that a query looks at: those of its rarest words, so that it costs no more in a large map


class Retrieval:
    """Grows by one keyframe at a time; asks which keyframes share rare words with an image."""

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._bits = np.stack([random.choice(256, BITS, replace=False) for _ in range(TABLES)])
        self._postings: dict[int, array[int]] = defaultdict(partial(array, "i"))  # of a word: places in `_indices`
        self._indices: list[int] = []  # of keyframes, as they were added
        self._places: dict[int, int] = {}  # in it

    def add(self, index: int, descriptors: np.ndarray) -> None:
        """descriptors: (N, 32) uint8."""
        place = self._places[index] = len(self._indices)
        self._indices.append(index)
        for word in np.unique(self._words(descriptors)).tolist():
            self._postings[word].append(place)

    def query(self, descriptors: np.ndarray, count: int, exclude: set[int], usual: set[int] | None = None) -> list[int]:
        """The keyframes outside `exclude` that look most alike, best first.

        usual: keyframes that are known to see the same: those that look less than half as much like it are no match.
        """
        words = np.unique(self._words(descriptors)).tolist()
        found = [postings for postings in map(self._postings.get, words) if postings is not None]
        if not found:
            return []
        lengths = np.array(list(map(len, found)))
        if lengths.sum() > MOST_POSTINGS:
            rarest = np.argsort(lengths, kind="stable")
            rarest = np.sort(rarest[np.cumsum(lengths[rarest]) <= MOST_POSTINGS])
            found, lengths = [found[n] for n in rarest], lengths[rarest]
        rarity = np.log(1.0 + len(self._indices) / lengths)
        places = np.frombuffer(b"".join(found), np.int32)
        scores = np.bincount(places, np.repeat(rarity, lengths), len(self._indices))
        known = [self._places[index] for index in usual or () if index in self._places]
        min_score = 0.5 * max((scores[place] for place in known), default=0.0)
        scores[[self._places[index] for index in exclude if index in self._places]] = 0.0
        good = np.flatnonzero((scores > 0.0) & (scores >= min_score))
        best = np.lexsort((np.array(self._indices)[good], -scores[good]))[:count]
        return [self._indices[place] for place in good[best]]

    def _words(self, descriptors: np.ndarray) -> np.ndarray:
        if len(descriptors) == 0:
            return np.zeros(0, np.int64)
        bits = np.unpackbits(descriptors.T, axis=0)[self._bits]
        low, high = np.packbits(bits, axis=1, bitorder="little").transpose(1, 0, 2).astype(np.int64)
        return np.asarray(low + (high << 8) + (np.arange(TABLES)[:, None] << BITS)).ravel()


__all__ = ["Retrieval"]
