"""Whether matches tie keyframes to each other, and the distances between them.

Two views tell the direction between them, not how far it is. How much longer one such distance is than another is told
by points that are seen from both pairs alone: where each of a keyframe's points is found in one neighbor or the other,
and hardly any in both, what lies on either side may be stretched at will, and no residual tells of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from mvsgs_core.tracking.graph import KeyframeGraph

SHARED = 30  # points of a keyframe, found in two others, that tie the distances to both


def share_scale(graph: KeyframeGraph, keyframes: Sequence[int]) -> bool:
    """Whether the matches between keyframes, by index, leave no scale open: one in which all distances are tied."""
    wanted = set(keyframes)
    ends: dict[int, list[int]] = {index: [] for index in wanted}
    for source, to in graph.edges.of(wanted):
        if source in wanted and to in wanted:
            ends[source].append(to)
    tied: list[set[frozenset[int]]] = []  # pairs whose distances are, by ties that have no pair in common
    for source, found in ends.items():
        points = {to: graph.edges[source, to].found for to in found}
        for a, b in combinations(found, 2):
            if (points[a] & points[b]).sum() < SHARED:
                continue
            new = {frozenset((source, a)), frozenset((source, b))}
            touched = [group for group in tied if group & new]
            tied = [group for group in tied if not group & new] + [new.union(*touched)]
    return any(wanted <= frozenset().union(*group) for group in tied)


def tied_parts(graph: KeyframeGraph, keyframes: Sequence[int]) -> list[set[int]]:
    """These keyframes in parts that no edge leads between; the last part has the newest of them."""
    left, parts = set(keyframes), list[set[int]]()
    while left:
        part, found = set[int](), {max(left)}
        while part != found:
            part, found = found, graph.edges.reached(found) & left
        parts.append(part)
        left -= part
    return parts[::-1]


__all__ = ["share_scale", "tied_parts"]
