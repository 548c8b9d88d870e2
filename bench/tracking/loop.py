"""A loop whose scale has drifted: what closing it does to the trajectory, and whether the mapper's splats follow it.

The drift is put into a map that was tracked without loops; the tracker's own loop closure then takes it out. A mapper
that was given the drifted keyframes and hears of the correction afterwards is compared with one that does not hear of
it, and with one that had the corrected keyframes from the start, after the same optimization. Depth maps are true ones
in the tracker's scale, so that only the correction is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.aligned import aligned_error
from bench.table import Row, at_least, at_most
from mvsgs_core import geometry, image_metrics
from mvsgs_core.datasets import Item
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.publish import Correction
from mvsgs_core.tracking.steps import whole
from mvsgs_core.tracking.tracker import Tracker, TrackerConfig

PIXELS = 160 * 120  # of the mapper's images
EVERY = 2  # which keyframes are mapped
ITERATIONS = 10  # of the mapper for each keyframe
REFINEMENT = 300  # iterations of the mapper after the correction


@dataclass(frozen=True)
class Closed:
    """Keyframes before and after the loop was closed; the correction is what the tracker publishes."""

    before: dict[int, np.ndarray]  # (4, 4) world_from_cam by frame
    units: dict[int, float]  # by frame: its depths in the drifted map, over true ones
    correction: Correction | None  # None: the loop was not found, or nothing moved
    error_before: float  # ATE in meters
    error_after: float


def close_loop(items: Sequence[Item], drift: float = 0.25) -> Closed:
    """Tracks without loops, removes matches between the two ends, scales every step, and closes the loop."""
    tracker = Tracker(TrackerConfig(loops=False))
    for item in items:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    session = tracker.session
    graph = session.graph
    order = sorted(graph.keyframes)
    place = {index: n for n, index in enumerate(order)}
    for a, b in [pair for pair in graph.edges if abs(place[pair[0]] - place[pair[1]]) > len(order) // 4]:
        del graph.edges[a, b]
    _let_drift(graph, order, drift)
    for index in order:
        session.publisher.publish(index)
    before = {index: graph.world_from_cam(index) for index in order}
    units = {item.index: _unit(graph, item) for item in items if item.index in place}
    error = _error(graph, order, items)
    for index in order[:-1]:
        session.loops.add(index)
    closure = whole(session.loops.searching(order[-1]))
    if closure is None or not closure.moved:
        return Closed(before, units, None, error, error)
    session.back_end.adjust(graph.keyframes[order[0]].segment)
    return Closed(before, units, session.publisher.corrections(True), error, _error(graph, order, items))


@dataclass(frozen=True)
class MapScores:
    """Mean PSNR over the mapped keyframes, dB. The three at the end have had the same optimization."""

    before: float  # the drifted map
    after: float  # the same right after the correction
    followed: float  # that, after the refinement
    uncorrected: float  # the drifted map after the refinement
    known: float  # a map that had the corrected keyframes from the start, after the refinement


def map_scores(items: Sequence[Item], closed: Closed) -> MapScores:
    """Raises ValueError where nothing was corrected."""
    correction = closed.correction
    if correction is None:
        raise ValueError("the loop was not closed: there is no correction to follow")
    scale = dict(zip(correction.index.tolist(), correction.scale.tolist(), strict=True))
    after = dict(zip(correction.index.tolist(), correction.world_from_cam, strict=True))
    follows, stays, knows = _mapper(), _mapper(), _mapper()
    for item in [item for item in items if item.index in closed.before][::EVERY]:
        n = item.index
        for mapper in (follows, stays):
            mapper.add_keyframe(_view(item, closed.before[n], closed.units[n], 1.0))
        knows.add_keyframe(_view(item, after[n], closed.units[n] * scale[n], scale[n]))
    for mapper in (follows, stays, knows):
        while mapper.step():
            pass
    before = _score(follows)
    follows.correct(correction.index, correction.world_from_cam, correction.scale)
    corrected = _score(follows)
    for mapper in (follows, stays, knows):
        for done in range(REFINEMENT):
            mapper.refine(done, REFINEMENT)
    return MapScores(before, corrected, _score(follows), _score(stays), _score(knows))


def rows(items: Sequence[Item], drift: float = 0.25) -> list[Row]:
    closed = close_loop(items, drift)
    name = f"loop with {100 * drift:.0f} % drift of scale"
    found = [
        Row(f"{name}: ATE before", 100.0 * closed.error_before, "cm"),
        at_least(f"{name}: before / after", closed.error_before / closed.error_after, "", 3.0),
    ]
    if closed.correction is None:
        return [*found, Row(f"{name}: map", "the loop was not closed", "", "follows", False)]
    scores = map_scores(items, closed)
    more = f"after {REFINEMENT} iterations more"
    return [
        *found,
        Row(f"{name}: map before the correction", scores.before, "dB"),
        Row(f"{name}: map right after it", scores.after, "dB"),
        Row(f"{name}: map {more}", scores.followed, "dB"),
        Row(f"{name}: map {more}, without the correction", scores.uncorrected, "dB"),
        at_most(f"{name}: rendering lost by the correction", scores.uncorrected - scores.followed, "dB", 0.3),
        Row(f"{name}: a map of the corrected poses from the start is better by", scores.known - scores.followed, "dB"),
    ]


def _mapper() -> OnlineMapper:
    config = MapperConfig(iterations=ITERATIONS, max_pixels=PIXELS, threads=1)
    return OnlineMapper(config)


def _view(item: Item, pose: np.ndarray, unit: float, scale: float) -> RGBDKeyframe:
    assert item.depth is not None
    depth = item.depth[::2, ::2] * np.float32(unit)
    return RGBDKeyframe(item.index, item.image, item.intrinsics, pose, depth, scale)


def _score(mapper: OnlineMapper) -> float:
    """Mean PSNR over all keyframes, at the size that it trains on."""
    scores = []
    for view in mapper.views:
        color = mapper.render(view).color.clamp(0.0, 1.0).numpy()
        scores.append(image_metrics.psnr(color, view.target.numpy()))
    return float(np.mean(scores))


def _unit(graph: KeyframeGraph, item: Item) -> float:
    """Depth in the tracker's map over true depth: the median over the points that are triangulated."""
    assert item.depth is not None
    keyframe = graph.keyframes[item.index]
    height, width = item.depth.shape
    at = keyframe.points * ((width, height) / np.array(keyframe.image.size[::-1]))
    u, v = np.rint(at).astype(int).T
    depth = item.depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    known = keyframe.triangulated & (depth > 0)
    return float(np.median(1.0 / (keyframe.inverse_depth[known] * depth[known])))


def _let_drift(graph: KeyframeGraph, order: list[int], drift: float) -> None:
    old = {index: graph.keyframes[index].cam_from_world for index in order}
    for n, index in enumerate(order[1:], start=1):
        keyframe, last = graph.keyframes[index], order[n - 1]
        scale = float(np.exp(-drift * n / len(order)))
        step = old[index] @ geometry.inverse(old[last])
        step[:3, 3] *= scale
        keyframe.cam_from_world = step @ graph.keyframes[last].cam_from_world
        keyframe.inverse_depth = keyframe.inverse_depth / scale
        keyframe.information = keyframe.information * scale**2


def _error(graph: KeyframeGraph, order: list[int], items: Sequence[Item]) -> float:
    truth = {i.index: i.world_from_cam for i in items}
    found = np.stack([graph.world_from_cam(index)[:3, 3] for index in order])
    wanted = np.stack([np.asarray(truth[index])[:3, 3] for index in order])
    return aligned_error(found, wanted)
