"""The backend: bundle adjustment of the whole video over a graph of its own (DROID-SLAM, section 3.3)."""

from __future__ import annotations

from mvsgs_core.droid.config import Constants, CorrelationKind
from mvsgs_core.droid.factor_graph import FactorGraph
from mvsgs_core.droid.networks import Networks
from mvsgs_core.droid.proximity import by_proximity
from mvsgs_core.droid.video import Video
from mvsgs_core.stats import Stats

FACTORS_PER_KEYFRAME = 16  # each with a hidden state of its own while the graph is adjusted
_MIN_KEYFRAMES = 3


def adjust_globally(
    video: Video,
    networks: Networks,
    constants: Constants,
    steps: int,
    correlation: CorrelationKind,
    threads: int,
    stats: Stats,
) -> None:
    """Normalizes the scale, chooses edges among all keyframes, and updates all of them `steps` times."""
    if len(video) < _MIN_KEYFRAMES:
        return
    video.normalize()
    graph = FactorGraph(video, networks, correlation=correlation, transient=True, threads=threads)
    near = by_proximity(
        video,
        first_source=0,
        first_to=0,
        existing=[],
        radius=constants.backend_radius,
        nms=constants.backend_nms,
        threshold=constants.backend_threshold,
        beta=constants.beta,
        limit=FACTORS_PER_KEYFRAME * len(video),
    )
    stats.count("global edges", graph.add(near))
    for _ in range(steps):
        stats.count("edges revised", len(graph.active))
        solution = graph.update_globally()
        if solution.failure:
            stats.count("failed bundle adjustments")
            stats.warn(f"global bundle adjustment failed: {solution.failure}")


__all__ = ["FACTORS_PER_KEYFRAME", "adjust_globally"]
