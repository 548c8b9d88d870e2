"""What the check of a focal length at the end of a stream asks, and what it says."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.estimation import calibration
from mvsgs_core.tracking.estimation.calibration import MANY, Calibration
from mvsgs_core.tracking.estimation.focal import FocalConfig, Uncertainty
from mvsgs_core.tracking.estimation.radial import Radial
from mvsgs_core.tracking.estimation.rolling_shutter import Readout
from mvsgs_core.tracking.graph import KeyframeGraph
from mvsgs_core.tracking.steps import Steps
from mvsgs_core.tracking.tracker import Tracker
from tests.support.shared_data import shared

CAMERA = np.array([300.0, 310.0, 319.5, 239.5])  # of the original images


@pytest.mark.parametrize(
    ("of_map", "said"),
    [
        (False, ("the given calibration", "390 px in the original images, 1.300 times the 300 px that were given")),
        (
            True,
            ("the map's focal length", "325 px in the original images, 1.300 times the 250 px of the map", "map=DIR"),
        ),
    ],
)
def test_a_contradiction_is_told_of_the_focal_length_that_was_used(
    of_map: bool, said: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a map holds for frames that came with another one."""
    monkeypatch.setattr(calibration, "find_zoom", lambda *_: None)
    monkeypatch.setattr(calibration, "focal_of_all", lambda *_: 1.3)
    monkeypatch.setattr(calibration, "observability", lambda *_: np.inf)
    monkeypatch.setattr(calibration, "uncertainty", lambda *_: Uncertainty(0.01, 0.01, 3))
    stats, graph = Stats(), KeyframeGraph(np.array([150.0, 150.0, 160.0, 120.0]))
    checked = Calibration(graph, FocalConfig(), stats, CAMERA, False, 0.0, False, 1)
    if of_map:
        checked.of_map, graph.intrinsics = True, np.array([125.0, 125.0, 160.0, 120.0])
    checked.check(list(range(20)))
    (warning,) = stats.warnings
    for text in said:
        assert text in warning
    assert ("dataset.intrinsics=[390.0,403.0,319.5,239.5]" in warning) != of_map
    assert stats.values["focal_checked_px"] == pytest.approx(325.0 if of_map else 390.0)


@pytest.mark.parametrize("own", [20, 3])
def test_on_a_large_map_the_stream_s_own_keyframes_are_asked(own: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The map's agree with the focal length that they were made with; of a few keyframes nothing can be told."""
    asked: list[list[int]] = []
    monkeypatch.setattr(calibration, "find_zoom", lambda *_: None)
    monkeypatch.setattr(calibration, "focal_of_all", lambda graph, members, threads: asked.append(members))
    graph = KeyframeGraph(np.array([150.0, 150.0, 160.0, 120.0]))
    checked = Calibration(graph, FocalConfig(), Stats(), CAMERA, False, 0.0, False, 1)
    checked.check([*range(-200, 0), *range(own)])
    assert (asked[0][0] == 0) == (own == 20)


@pytest.mark.parametrize(
    ("parts", "spread", "said"), [(3, 0.01, True), (3, 0.02, False), (2, 0.01, False), (0, 0.0, False)]
)
def test_what_few_parts_of_a_stream_want_contradicts_nothing(
    parts: int, spread: float, said: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The spread of two or three is itself uncertain, and where there is none nobody knows what errs alike."""
    monkeypatch.setattr(calibration, "find_zoom", lambda *_: None)
    monkeypatch.setattr(calibration, "focal_of_all", lambda *_: 1.06)
    monkeypatch.setattr(calibration, "observability", lambda *_: np.inf)
    monkeypatch.setattr(calibration, "uncertainty", lambda *_: Uncertainty(0.01, spread, parts))
    stats, graph = Stats(), KeyframeGraph(np.array([150.0, 150.0, 160.0, 120.0]))
    Calibration(graph, FocalConfig(), stats, CAMERA, False, 0.0, False, 1).check(list(range(20)))
    assert bool(stats.warnings) == said


def test_a_map_that_could_not_be_solved_with_the_guess_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its poses stay those of another focal length."""
    monkeypatch.setattr(calibration, "observability", lambda *_: 0.0)
    for failure in ("", "no step"):
        stats, graph = Stats(), KeyframeGraph(np.array([150.0, 150.0, 160.0, 120.0]))
        solved = SimpleNamespace(failure=failure)
        monkeypatch.setattr(graph, "optimize", lambda *_, solved=solved: solved)
        monkeypatch.setattr(graph, "but_first", set)
        Calibration(graph, FocalConfig(), stats, CAMERA, True, 0.0, False, 1).settle([0, 1, 2])
        assert any("no step" in warning for warning in stats.warnings) == bool(failure)
        assert stats.counts.get("failed bundle adjustments", 0) == bool(failure)


def test_what_the_next_run_is_told_to_take_is_in_pixels_of_the_original_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `dataset.intrinsics` is, whatever size the frames came at."""
    monkeypatch.setattr(calibration, "observability", lambda *_: np.inf)
    monkeypatch.setattr(calibration, "uncertainty", lambda *_: Uncertainty(0.01))
    monkeypatch.setattr(calibration, "lens_problem", lambda *_: None)
    monkeypatch.setattr(calibration, "estimate_radial", lambda *_: Radial(-0.2, 0.01, 1.05, 1.5))
    stats, graph = Stats(), KeyframeGraph(np.array([150.0, 155.0, 159.5, 119.5]))
    found = Calibration(graph, FocalConfig(), stats, CAMERA, True, 0.0, False, 1)
    graph.intrinsics = found.given * [1.2, 1.2, 1.0, 1.0]
    found.settle([0, 1, 2])
    assert stats.values["focal_px"] == pytest.approx(360.0)
    (warning,) = (warning for warning in stats.warnings if "the lens bends" in warning)
    assert "dataset.intrinsics=[378.0,390.6,319.5,239.5] and dataset.distortion=[-0.2000,0,0,0]" in warning


def test_a_few_frames_of_a_real_video_contradict_no_calibration() -> None:
    tracker = Tracker()
    for item in open_dataset("tum", path=shared("data/tum_fr1_xyz"), size=(240, 320), stride=2, stop=48):
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    list(tracker.finish())
    assert tracker.trajectory().keyframe.sum() >= FocalConfig().min_keyframes, "fewer are not asked"
    assert not any("contradict" in warning for warning in tracker.stats.warnings)


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
    monkeypatch.setattr(calibration, "observability", says(0.1))
    monkeypatch.setattr(calibration, "uncertainty", says(Uncertainty(0.001)))
    monkeypatch.setattr(calibration, "lens_problem", says(None))
    monkeypatch.setattr(calibration, "estimate_radial", lambda *_: Radial(0.0, 0.01, 1.0, 1.5))
    stats, graph = Stats(), KeyframeGraph(np.array([300.0, 300.0, 160.0, 120.0]))
    checked = Calibration(graph, FocalConfig(), stats, CAMERA, True, 0.0, False, 1)
    stats.values["focal_sigma_percent"] = 1.0
    checked.check(list(range(keyframes)))
    assert seen == [list(range(asked))] * 4
    (warning,) = stats.warnings
    assert warning.startswith(f"{who} want a focal length of 360 px")
    assert "dataset.intrinsics=[360.0,372.0,319.5,239.5]" in warning


def readouts(monkeypatch: pytest.MonkeyPatch) -> tuple[Calibration, list[list[int]]]:
    """A calibration, and the keyframes that each estimate of its readout time is from."""
    asked: list[list[int]] = []

    def estimating(graph: KeyframeGraph, members: list[int], threads: int) -> Steps[Readout]:
        asked.append(members)
        yield
        return Readout(0.001 * len(members), False)

    monkeypatch.setattr(calibration, "estimating_readout", estimating)
    graph = KeyframeGraph(np.array([150.0, 150.0, 160.0, 120.0]))
    return Calibration(graph, FocalConfig(), Stats(), CAMERA, False, None, False, 1), asked


def test_the_start_of_another_part_does_not_change_a_readout_time_of_more_keyframes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, asked = readouts(monkeypatch)
    found.estimate_readout(list(range(6)))
    found.estimate_readout(list(range(20)))
    found.estimate_readout(list(range(100, 110)))
    assert asked == [list(range(6)), list(range(8, 20))]
    assert found.graph.readout_time == pytest.approx(0.012)
    found.estimate_readout(list(range(100, 150)), newest=40)
    assert asked[2:] == [list(range(110, 150))]
    found.estimate_readout(list(range(200, 210)))
    assert found.graph.readout_time == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("counts", "estimated"),
    [
        ([6, 7, 10, 11, 12, 20, 30, 40, 41, 90], [10, 20, 40]),
        ([8, 16, 17, 18, 35, 55, 56], [16, 35, 55]),  # another part was joined, whose keyframes came at once
    ],
)
def test_the_readout_time_is_estimated_again_whatever_number_of_keyframes_is_jumped_over(
    counts: list[int], estimated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, asked = readouts(monkeypatch)
    found.estimate_readout(list(range(counts[0])))
    for count in counts[1:]:
        if found.readout_due(count):
            found.estimate_readout(list(range(count)))
    assert [members[-1] + 1 for members in asked] == [counts[0], *estimated]
