"""How far the result can be trusted: what the tracker says of it in its warnings."""

from __future__ import annotations

import numpy as np

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation.static_points import STILL
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.trajectory import TrackingState, Trajectory


def warn_of_gaps(stats: Stats, trajectory: Trajectory) -> None:
    """Frames without a pose, and a map in several segments."""
    segments = len(np.unique(trajectory.segment[trajectory.keyframe]))
    if segments > 1:
        stats.warn(f"the map is in {segments} segments: no verified loop joins them")
    lost, unstarted = (
        int(np.sum(trajectory.state == TrackingState.LOST)),
        int(np.sum(trajectory.state == TrackingState.NOT_INITIALIZED)),
    )
    if lost:
        stats.warn(f"{lost} of {len(trajectory.state)} frames were lost")
    if 0 < unstarted < len(trajectory.state):  # none at all started: that is the reason for no map
        stats.warn(f"{unstarted} of {len(trajectory.state)} frames came before a start and have no pose")


def warn_of_few_matches(stats: Stats, graph: KeyframeGraph, enough: int) -> None:
    """Few points hold the poses: their errors do not average out, and the whole map bends without any residual."""
    if not graph.edges:
        return
    found = float(np.median([edge.matches for edge in graph.edges.values()]))
    stats.counts["matches of a pair of keyframes, median"] = found
    if found < enough:
        stats.warn(
            f"few matches: {found:.0f} of a pair of keyframes, {enough} are enough. Poses and depths may be bent as a "
            "whole; larger images (dataset.size, tracker.area) or a scene with more texture help"
        )


def tell_what_moves(stats: Stats, graph: KeyframeGraph) -> None:
    """How many points no standing point explains, over all keyframes in which they were found: left out of poses."""
    weights = [keyframe.static[keyframe.static < 1.0] for keyframe in graph.keyframes.values()]
    seen = sum(len(some) for some in weights)
    if graph.weighing and seen:
        left_out = sum(int(np.sum(some <= STILL)) for some in weights)
        stats.counts["points that move, or contradict the map"] = left_out
        stats.values["points that stand still"] = f"{100 * (1 - left_out / seen):.0f} % of those seen again"


__all__ = ["tell_what_moves", "warn_of_few_matches", "warn_of_gaps"]
