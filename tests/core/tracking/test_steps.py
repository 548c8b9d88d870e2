"""Work in steps: no step holds more than one bundle adjustment, and between steps the graph is as it was."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mvsgs_core.tracking.back_end import BackEnd, BackEndConfig
from mvsgs_core.tracking.diagnosis import Diagnosis
from mvsgs_core.tracking.estimation import bundle_adjustment, rolling_shutter
from mvsgs_core.tracking.estimation.focal import FocalConfig
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.initializer import InitializationConfig, Initializer
from mvsgs_core.tracking.local_map import LocalMap, LocalMapConfig
from mvsgs_core.tracking.places.geometric_verification import PlaceMatch, verifying_place
from mvsgs_core.tracking.places.pose_criteria import PoseCriteria
from mvsgs_core.tracking.steps import Steps
from tests.support.true_maps import exact_matches, image, item, matcher, true_graph, true_pose

FRAMES = (0, 4, 8, 12)


@pytest.fixture
def adjustments(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """One number a bundle adjustment that was made, anywhere in the tracker."""
    made: list[int] = []
    adjust = bundle_adjustment.adjust

    def counted(*given: Any) -> bundle_adjustment.Solution:
        made.append(len(made))
        return adjust(*given)

    for name, module in list(sys.modules.items()):
        if name.startswith("mvsgs_core.tracking.") and getattr(module, "adjust", None) is adjust:
            monkeypatch.setattr(module, "adjust", counted)
    return made


def state(graph: KeyframeGraph) -> list[np.ndarray]:
    """What frames are followed by."""
    keyframes = [array for k in graph.keyframes.values() for array in (k.cam_from_world, k.inverse_depth)]
    return [
        graph.intrinsics.copy(),
        np.array([graph.readout_time, graph.reads_columns]),
        *(array.copy() for array in keyframes),
    ]


def stepwise(steps: Steps[Any], graph: KeyframeGraph, adjustments: list[int]) -> Iterator[int]:
    """The adjustments of each step, at whose end but for the last the graph is as it was."""
    before = state(graph)
    while True:
        count = len(adjustments)
        try:
            next(steps)
        except StopIteration:
            yield len(adjustments) - count
            return
        for one, other in zip(before, state(graph), strict=True):
            np.testing.assert_array_equal(one, other)
        yield len(adjustments) - count


def connected() -> KeyframeGraph:
    graph = true_graph(*FRAMES)
    for a in FRAMES:
        for b in FRAMES:
            if a != b:
                graph.connect(a, b, exact_matches(graph, a, graph.keyframes[b].cam_from_world), 0.1)
    return graph


def test_the_readout_time_is_tried_one_by_one(adjustments: list[int]) -> None:
    graph = connected()
    graph.readout_time = 0.004
    work = list(stepwise(rolling_shutter.estimating_readout(graph, FRAMES, 1), graph, adjustments))
    assert sum(work) == 7, "0, one in each of four directions, and two more in that of which it leaves the least cost"
    assert max(work) == 1


@pytest.mark.parametrize("focal", [None, FocalConfig(factors=(1.0, 1.35))])
def test_the_first_solution_is_made_one_adjustment_after_another(
    adjustments: list[int], focal: FocalConfig | None
) -> None:
    true, graph = true_graph(*FRAMES), KeyframeGraph(item(0).intrinsics)
    made = Initializer(graph, matcher(), InitializationConfig(min_keyframes=4), 1, Diagnosis(0.2, 0.05))
    made.add(image(FRAMES[0]), 0)
    for before, index in pairwise(FRAMES):
        made.add(image(index), 0, exact_matches(true, before, true_pose(index)))
    work = list(stepwise(made.initializing(focal=focal), graph, adjustments))
    assert made.waiting == [], "solved"
    assert sum(work) >= (5 if focal is None else 10)
    assert max(work) == 1


def test_background_work_is_set_up_and_solved_apart(adjustments: list[int]) -> None:
    graph = connected()
    back_end = BackEnd(graph, LocalMap(graph, matcher(), LocalMapConfig(), 1), BackEndConfig(), 1)
    back_end.pending = 2
    assert list(stepwise(back_end.working(0), graph, adjustments)) == [0, 1]
    assert back_end.pending == 1


def test_a_place_is_verified_in_parts(adjustments: list[int]) -> None:
    graph = true_graph(100)
    steps = verifying_place(graph, matcher(), 100, image(106), PoseCriteria())
    next(steps)  # features
    next(steps)  # matches
    assert not adjustments
    with pytest.raises(StopIteration) as end:
        next(steps)
    assert isinstance(end.value.value, PlaceMatch)
    assert len(adjustments) == 1
