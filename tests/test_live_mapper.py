"""The mapper node at the end of a live stream: what is handed out before the refinement."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import SplatMap
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.coarse import LATER
from mvsgs_core.mapping.mapper import NONE_NOW
from nodes.last_seconds import LAST_SECONDS, LastSeconds
from nodes.mapper import Mapper
from tests.support.mapper_messages import settings, view_message

LOOKS = 21  # at the clock, until the last seconds are over


def counted(seconds: float) -> LastSeconds:
    """By a clock that others' load cannot hold up: it goes on with every look, for so many seconds."""
    now = iter(np.linspace(100.0, 100.0 + seconds, LOOKS))
    return LastSeconds(clock=lambda: float(next(now, 1e9)))


def test_a_live_map_is_handed_out_soon_after_the_last_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many iterations are left: as many of them as the refinement has are made up before it."""
    captured = time.time()

    def maps(age: float) -> tuple[Mapper, SplatMap, SplatMap]:
        node = Mapper(replace(settings(iterations=100_000, refinement=2), realtime=True))
        node._last_seconds = counted(LAST_SECONDS)
        with monkeypatch.context() as now:
            now.setattr("nodes.last_seconds.time.time", lambda: captured + age)
            list(node.on_fused_keyframe(replace(view_message(0, 0.5), captured=captured)))
        before, after = (message for message in node.on_end() if isinstance(message, SplatMap))
        assert after.iterations == before.iterations + 2 + 2
        assert node.stats.counts["iterations made up"] == 2
        return node, before, after

    node, half, _ = maps(age=0.5 * LAST_SECONDS)
    assert 0 < half.iterations < LOOKS / 2
    assert node.stats.values["latency"]["keyframe to map"]["count"] == 1
    assert half.iterations < maps(age=0.0)[1].iterations < LOOKS
    assert maps(age=60.0)[1].iterations == 0


def test_a_live_map_is_handed_out_at_falling_rates_and_goes_on_at_full_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """At full rates it shows most what the last few images pulled at."""
    node = Mapper(replace(settings(iterations=1000, refinement=3), realtime=True))
    node._last_seconds = counted(LAST_SECONDS)
    list(node.on_fused_keyframe(replace(view_message(0, 0.5), captured=time.time() + 60.0)))  # a host's that is ahead
    trainer, rates = node.atlas.current.trainer, []
    step = trainer.step

    def noted(*given: Any, **more: Any) -> None:
        rates.append(trainer.rate)
        step(*given, **more)

    monkeypatch.setattr(trainer, "step", noted)
    monkeypatch.setattr("nodes.last_seconds.time.time", lambda: 0.0)  # and set back, to 1970
    before = next(m for m in node.on_end() if isinstance(m, SplatMap))
    assert before.iterations == len(rates) > 5
    assert rates == sorted(rates, reverse=True)
    assert rates[0] > 0.8
    assert rates[-1] < 0.2
    assert trainer.rate == 1.0


def test_what_a_camera_that_stood_still_waited_is_no_latency() -> None:
    now = [100.0]
    for waited, told in ((0.5, True), (60.0, False)):
        node = Mapper(replace(settings(), realtime=True))
        node._last_seconds = LastSeconds(clock=lambda: now[0])
        list(node.on_fused_keyframe(replace(view_message(0, 0.5), captured=time.time())))
        now[0] += waited
        list(node.on_end())
        assert ("last keyframe to the map before its refinement" in node.stats.values["latency"]) == told


def test_what_a_live_map_was_left_without_it_gets_where_a_recording_goes_on_in_it(tmp_path: Path) -> None:
    live = Mapper(replace(settings(), realtime=True))
    for k in range(2):
        live._add(view_message(7 * k, k / 2), NONE_NOW)
    CheckpointWriter(tmp_path, live.config).write(live.atlas.frozen())
    recorded = Mapper(settings(map=str(tmp_path)))
    assert len(recorded.atlas.current.coarse) == 2
    list(recorded.on_end())
    assert recorded.stats.counts[LATER] == 2
    assert len(np.unique(recorded.atlas.current.state.anchors.numpy())) == 2
