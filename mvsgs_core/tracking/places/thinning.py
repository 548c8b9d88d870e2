"""The pose graph of a large map: of some of its keyframes; those between them follow.

A loop's error is spread over kilometers, so it changes little from one keyframe to the next: a few hundred tell where
all of them go, and what a loop costs does not grow with the map.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.pose_graph import (
    PoseGraphSolution,
    SimilarityEdges,
    inverse_similarity,
    scale_of,
    solve_pose_graph,
)

MAX_NODES = 300  # keyframes that are solved as they are
THINNED = 150  # that are solved for of more
UNMATCHED = 1e3  # times as loose: neighbors in the stream that no match ties, as where the camera was lost between them


def solve_thinned(poses: np.ndarray, edges: SimilarityEdges) -> PoseGraphSolution:
    """Poses (K, 4, 4) in the order of the stream, whose first one stays, where the last edge is the loop.

    All other edges hold as it is. See `solve_pose_graph`, which small graphs are given to.
    """
    count = len(poses)
    if count <= MAX_NODES:
        return solve_pose_graph(poses, edges, {0})
    loose = np.flatnonzero(_loose(edges))[-(MAX_NODES - THINNED) // 2 :]
    ends = [edges.source[-1:], edges.to[-1:], edges.source[loose], edges.to[loose]]
    nodes = thinned(count, {int(end) for end in np.concatenate(ends)})
    solution = solve_pose_graph(poses[nodes], _between(poses, edges, nodes), {0})
    if solution.failure or not np.isfinite(solution.similarities).all():
        return solution
    return replace(solution, similarities=follow(poses, nodes, solution.similarities))


def thinned(count: int, kept: set[int]) -> np.ndarray:
    """Places of the nodes, ascending: evenly spaced, both ends, and these."""
    even = np.linspace(0, count - 1, THINNED).round().astype(int).tolist()
    return np.array(sorted({*even, *kept}))


def joining(count: int, matched: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """Steps of `count` keyframes in the order of the stream that join what no pair of `matched` ties together."""
    group = np.arange(count)
    for a, b in matched:
        if group[a] != group[b]:
            group[group == group[b]] = group[a]
    steps = set()
    for a, b in pairwise(range(count)):
        if group[a] != group[b]:
            group[group == group[b]] = group[a]
            steps.add((a, b))
    return steps


def _loose(edges: SimilarityEdges) -> np.ndarray:
    """(E - 1,) bool: the steps that nobody measured, whose sigma is larger. Nodes stand on both sides of each."""
    return np.asarray(edges.sigma[:-1, 0] > edges.sigma[:-1, 0].min())


def _between(poses: np.ndarray, edges: SimilarityEdges, nodes: np.ndarray) -> SimilarityEdges:
    """Edges between the nodes: each step as loose as the steps that it stands for, and where others tie two of them."""
    # An edge counts for the nodes that its ends are nearest to.
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    source, to = (np.searchsorted(middles, ends[:-1]) for ends in (edges.source, edges.to))
    sigma, tight = edges.sigma[:-1].min(axis=0), ~_loose(edges)
    measured = np.zeros(len(poses), bool)  # of each keyframe: the step that begins there
    measured[edges.source[:-1][tight & (edges.to[:-1] - edges.source[:-1] == 1)]] = True
    variance = {}  # by nodes, over that of one step
    for n, (a, b) in enumerate(pairwise(nodes.tolist())):
        variance[n, n + 1] = (b - a) * (1.0 if measured[a:b].all() else UNMATCHED**2)
    for n, m in zip(source[tight].tolist(), to[tight].tolist()):
        if n != m:
            variance[n, m] = nodes[m] - nodes[n] if m - n == 1 else len(poses) / len(nodes)
    pairs = sorted(variance)
    a, b = np.array(pairs).T
    relative = poses[nodes[b]] @ geometry.inverse(poses[nodes[a]])
    loop = [int(np.searchsorted(nodes, end[-1])) for end in (edges.source, edges.to)]
    return SimilarityEdges(
        source=np.append(a, loop[0]),
        to=np.append(b, loop[1]),
        relative=np.concatenate([relative, edges.relative[-1:]]),
        sigma=np.concatenate([sigma * np.sqrt([[variance[pair]] for pair in pairs]), edges.sigma[-1:]]),
    )


def follow(poses: np.ndarray, nodes: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """Similarities (K, 4, 4) of all, where the nodes (N,), the first and the last among them, go to solved (N, 4, 4).

    One between two nodes keeps its place beside either, the more the nearer it is.
    """
    after = np.clip(np.searchsorted(nodes, np.arange(len(poses)), side="right"), 1, len(nodes) - 1)
    first, last = nodes[after - 1], nodes[after]
    beside_first = poses @ geometry.inverse(poses[first]) @ solved[after - 1]
    beside_last = poses @ geometry.inverse(poses[last]) @ solved[after]
    part = (np.arange(len(poses)) - first) / (last - first)
    apart = beside_last @ inverse_similarity(beside_first)
    scale = scale_of(apart)
    turn = geometry.so3_exp(part[:, None] * geometry.so3_log(apart[:, :3, :3] / scale[:, None, None]))
    step = np.tile(np.eye(4), (len(poses), 1, 1))
    step[:, :3, :3] = (scale**part)[:, None, None] * turn
    step[:, :3, 3] = part[:, None] * apart[:, :3, 3]
    return np.asarray(step @ beside_first)


__all__ = ["UNMATCHED", "follow", "joining", "solve_thinned", "thinned"]
