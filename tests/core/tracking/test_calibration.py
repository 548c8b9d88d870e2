"""What the check of a guessed focal length asks at the end of a long stream."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation import calibration
from mvsgs_core.tracking.estimation.calibration import MANY, Calibration
from mvsgs_core.tracking.estimation.focal import FocalConfig
from mvsgs_core.tracking.estimation.radial import Radial
from mvsgs_core.tracking.graph import KeyframeGraph


@pytest.mark.parametrize(
    ("keyframes", "asked", "who"),
    [(200, 200, "all keyframes together"), (3600, MANY, f"the first {MANY} keyframes")],
)
def test_adjustments_of_a_long_stream_are_of_no_more_keyframes_than_memory_is_for(
    keyframes: int, asked: int, who: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[int]] = []

    def says(value: Any) -> Any:
        def asking(graph: KeyframeGraph, members: list[int], *_: object) -> Any:
            seen.append(members)
            return value

        return asking

    monkeypatch.setattr(calibration, "find_zoom", lambda *_: None)  # of parts of the stream
    monkeypatch.setattr(calibration, "focal_of_all", says(1.2))
    monkeypatch.setattr(calibration, "uncertainty", says(0.001))
    monkeypatch.setattr(calibration, "lens_problem", says(None))
    monkeypatch.setattr(calibration, "estimate_radial", lambda *_: Radial(0.0, 0.01, 1.0, 1.5))
    stats, graph = Stats(), KeyframeGraph(np.array([300.0, 300.0, 160.0, 120.0]))
    checked = Calibration(graph, FocalConfig(), stats, 300.0, (240, 320), True, 0.0, False, 1)
    stats.values["focal_sigma_percent"] = 1.0
    checked.check(list(range(keyframes)))
    assert seen == [list(range(asked))] * 3
    (warning,) = stats.warnings
    assert warning.startswith(f"{who} want a focal length of 360 px")
