"""What moves is told from what stands by all matches of a point together.

A wrong match contradicts the map once; a point on a person contradicts it in every keyframe that sees it, each time by
little, and a robust cost, which judges one match at a time, lets many of them draw a pose along. So a point has a
weight of its own, by the mean over its matches.
"""

from __future__ import annotations

import numpy as np

from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, reproject

STILL = 0.1  # weight of a point below which it is not used where points are plenty
LARGEST = 100.0  # of a squared residual, pixels²: one wrong match does not condemn a point


def static_weights(graph: Graph) -> np.ndarray:
    """(K, M) how well each point stands still: 1 / (1 + q)², q the mean of its squared whitened residuals, in pixels².

    Of the matches from its own keyframe; `graph.static` is left out of account. NaN: no match speaks of it.
    """
    pixels, z = reproject(
        graph.cam_from_world, graph.inverse_depth, graph.pixels, graph.intrinsics, graph.source, graph.to
    )
    u, v = (graph.target - pixels).transpose(1, 0, 2)
    information = graph.information
    squared = information[:, 0] * u**2 + information[:, -1] * v**2
    if information.shape[1] == 3:
        squared = squared + 2.0 * information[:, 1] * u * v
    squared = np.where(z > 0.05, np.minimum(squared, LARGEST), LARGEST)
    found = information[:, 0] > 0
    total, count = np.zeros_like(graph.inverse_depth), np.zeros_like(graph.inverse_depth)
    for edge, keyframe in enumerate(graph.source):  # as one product it would start BLAS's threads
        total[keyframe] += np.where(found[edge], squared[edge], 0.0)
        count[keyframe] += found[edge]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.square(1.0 / (1.0 + total / count)))


__all__ = ["STILL", "static_weights"]
