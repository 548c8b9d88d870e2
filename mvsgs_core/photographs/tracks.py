"""Tracks: features of several photographs that are one point of the scene, from pairwise matches (union-find)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Tracks:
    """Observations, sorted by track and then by photograph; a track has at most one in a photograph."""

    track: np.ndarray  # (N,) int64, 0 to count - 1
    photograph: np.ndarray  # (N,) int64
    feature: np.ndarray  # (N,) int64 which feature of the photograph
    pixels: np.ndarray  # (N, 2) float64
    count: int

    def of_features(self, photograph: int, features: int) -> np.ndarray:
        """(features,) the track of each feature of a photograph, -1 of those in none."""
        found = np.full(features, -1)
        mine = self.photograph == photograph
        found[self.feature[mine]] = self.track[mine]
        return found


def link(points: list[np.ndarray], matches: Mapping[tuple[int, int], np.ndarray]) -> Tracks:
    """points: (N, 2) pixels of each photograph; matches: (M, 2) features of both, by pair.

    A track that holds two features of one photograph is two points of the scene or more: it loses all observations in
    that photograph.
    """
    offset = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    ends = [np.stack([offset[i] + m[:, 0], offset[j] + m[:, 1]], axis=1) for (i, j), m in matches.items()]
    label = _components(int(offset[-1]), np.concatenate([np.zeros((0, 2), np.int64), *ends]))
    photograph = np.repeat(np.arange(len(points)), [len(p) for p in points])
    _, track, length = np.unique(label, return_inverse=True, return_counts=True)
    key = track * max(len(points), 1) + photograph
    _, place, twice = np.unique(key, return_inverse=True, return_counts=True)
    keep = np.flatnonzero((length[track] > 1) & (twice[place] == 1))
    keep = keep[np.bincount(track, (length[track] > 1) & (twice[place] == 1))[track[keep]] > 1]
    _, track = np.unique(track[keep], return_inverse=True)
    order = np.lexsort((photograph[keep], track))
    keep, track = keep[order], track[order]
    pixels = np.concatenate([np.zeros((0, 2)), *points])[keep]
    feature = keep - offset[photograph[keep]]
    return Tracks(track, photograph[keep], feature, pixels, int(track[-1]) + 1 if len(track) else 0)


def _components(count: int, edges: np.ndarray) -> np.ndarray:
    """(count,) label of each node's connected component: its smallest node."""
    label = np.arange(count)
    while len(edges):
        low = label[edges].min(axis=1)
        before = label.copy()
        np.minimum.at(label, label[edges[:, 0]], low)
        np.minimum.at(label, label[edges[:, 1]], low)
        while True:  # to the root
            root = label[label]
            if np.array_equal(root, label):
                break
            label = root
        if np.array_equal(label, before):
            break
    return label


__all__ = ["Tracks", "link"]
