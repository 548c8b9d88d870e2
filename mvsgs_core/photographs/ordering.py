"""In which order photographs leave, so that stereo, which looks at the newest ones, finds neighbors among them."""

from __future__ import annotations

import numpy as np

RECENT = 4  # photographs that the next one is to see the same as


def covisibility(photograph: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    """(count, count) points that two photographs both see; 0 with itself. photograph, point: (N,) of observations."""
    shared = np.zeros((count, count))
    order = np.lexsort((photograph, point))
    photograph, point = photograph[order], point[order]
    for step in range(1, len(point)):
        same = point[step:] == point[:-step]
        if not same.any():
            break
        np.add.at(shared, (photograph[:-step][same], photograph[step:][same]), 1.0)
    np.fill_diagonal(shared, 0.0)
    return shared + shared.T


def chain(shared: np.ndarray, members: list[int]) -> list[int]:
    """The members in an order in which each sees much of what those right before it saw.

    Begins at one that sees little of the others, at an end of the path if there is one. shared: (P, P).
    """
    left = set(members)
    if not left:
        return []
    inside = shared[np.ix_(members, members)]
    out = [members[int(np.argmin(inside.sum(axis=1)))]]
    left.discard(out[0])
    while left:
        rest = sorted(left)
        near = sum(shared[rest, recent] / 2.0**age for age, recent in enumerate(reversed(out[-RECENT:])))
        chosen = rest[int(np.argmax(near))]
        out.append(chosen)
        left.discard(chosen)
    return out


__all__ = ["chain", "covisibility"]
