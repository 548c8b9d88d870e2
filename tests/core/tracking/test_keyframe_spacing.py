"""Keyframes of a live stream get farther apart where the tracker takes more than its share, and closer again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.tracking.config import TrackerConfig
from mvsgs_core.tracking.front_end import Step
from mvsgs_core.tracking.keyframe_choice import KeyframeChoice, KeyframeChoiceConfig
from mvsgs_core.tracking.keyframe_spacing import WIDEST, KeyframeSpacing, spacing_of
from mvsgs_core.tracking.matching.flow import Matches
from mvsgs_core.tracking.places.localization import Localization
from mvsgs_core.tracking.tracker import SPARED, Tracker
from tests.support.sequences import synthetic

FRAME = 1.0 / 30.0  # s
WIDTH = 320


def step(flow: float, fraction: float = 0.9) -> Step:
    return Step(0, Matches(np.zeros((0, 2)), np.zeros(0)), fraction, flow, False, None)


class Core:
    """A clock, and what the tracker takes of it."""

    def __init__(self) -> None:
        self.now = self.taken = 0.0

    def run(self, spacing: KeyframeSpacing, load: float, seconds: float) -> float:
        for _ in range(round(seconds / FRAME)):
            self.now, self.taken = self.now + FRAME, self.taken + load * FRAME
            spacing.look()
        return spacing.factor


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture
def spacing(core: Core) -> KeyframeSpacing:
    return KeyframeSpacing(0.5, lambda: core.now, lambda: core.taken)


def test_a_tracker_within_its_share_makes_keyframes_as_ever(core: Core, spacing: KeyframeSpacing) -> None:
    assert core.run(spacing, 0.45, 20.0) == 1.0


def test_one_beyond_it_makes_them_farther_apart_until_it_is_within(core: Core, spacing: KeyframeSpacing) -> None:
    assert 1.3 < core.run(spacing, 0.7, 1.1) < core.run(spacing, 0.7, 0.5) <= WIDEST
    assert core.run(spacing, 0.9, 10.0) == WIDEST
    held = core.run(spacing, 0.5, 5.0)
    assert core.run(spacing, 0.5, 5.0) == pytest.approx(held, rel=0.05)
    assert core.run(spacing, 0.3, 5.0) == 1.0


def test_it_settles_where_its_work_takes_its_share(core: Core, spacing: KeyframeSpacing) -> None:
    """Following frames takes .25 of a core, keyframes .45 at the usual distance."""
    for _ in range(60):
        core.run(spacing, 0.25 + 0.45 / spacing.factor, 0.5)
    assert spacing.factor == pytest.approx(1.8, rel=0.02)


def test_what_it_may_take_is_half_of_all_cores_or_what_is_said() -> None:
    assert [spacing_of(None, cores).share for cores in (1, 2, 16)] == [0.5, 0.9, 0.9]
    assert spacing_of(0.3, 16).share == 0.3
    for share in (0.0, 1.1, float("nan")):
        with pytest.raises(ValueError, match=r"tracker\.share=.*null: half of all"):
            TrackerConfig(share=share)


def test_a_keyframe_is_made_after_as_much_more_flow_and_the_spared_ones_are_counted(spacing: KeyframeSpacing) -> None:
    choice = KeyframeChoice(KeyframeChoiceConfig(), spacing)
    usual = choice.config.max_flow * WIDTH
    spacing.factor = 2.0
    assert choice.max_flow == 2.0 * choice.config.max_flow
    assert not choice.wants(1, step(1.9 * usual), WIDTH, choice.max_flow)
    assert choice.wants(2, step(2.1 * usual), WIDTH, choice.max_flow)
    assert spacing.spared == pytest.approx(1.0)
    assert choice.wants(3, step(0.2 * usual, fraction=0.3), WIDTH, choice.max_flow), "too few points are found"
    assert spacing.spared == pytest.approx(1.0), "that one would have been made anyway"
    every = KeyframeChoice(KeyframeChoiceConfig(max_flow=0.0), spacing)
    assert every.wants(4, step(1.0), WIDTH, every.max_flow)
    assert spacing.spared == pytest.approx(1.0), "nothing is farther apart than each frame"


def test_few_matches_that_agree_make_a_keyframe_as_early_as_ever(spacing: KeyframeSpacing) -> None:
    choice = KeyframeChoice(KeyframeChoiceConfig(), spacing)
    usual = choice.config.max_flow * WIDTH
    spacing.factor = 2.0
    for flow, inliers, wanted in ((0.6, 0.7, True), (0.4, 0.7, False), (1.9, 0.8, False)):
        seen = replace(step(flow * usual), localization=Localization(np.eye(4), inliers))
        assert choice.moved(seen, WIDTH, choice.max_flow) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [False, True])
def test_a_tracker_that_takes_too_much_makes_fewer_keyframes_in_real_time_alone(
    realtime: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keyframes(look: Callable[[KeyframeSpacing], None]) -> tuple[int, float]:
        monkeypatch.setattr(KeyframeSpacing, "look", look)
        tracker = Tracker(TrackerConfig(realtime=realtime))
        for item in synthetic(frames=80):
            tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
        for _ in tracker.finish():
            pass
        assert np.isfinite(tracker.trajectory().world_from_cam).all()
        return int(tracker.trajectory().keyframe.sum()), tracker.stats.skipped.get(SPARED, 0)

    def wide(spacing: KeyframeSpacing) -> None:
        spacing.factor = WIDEST

    usual, none = keyframes(lambda spacing: None)
    fewer, spared = keyframes(wide)
    assert none == 0
    if realtime:
        assert fewer < 0.7 * usual
        assert spared == pytest.approx(usual - fewer, abs=4)
    else:
        assert (fewer, spared) == (usual, 0)
