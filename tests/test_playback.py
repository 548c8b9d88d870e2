"""Recorded frames at their own pace, whatever befell the clock that they were recorded by."""

from __future__ import annotations

import numpy as np
import pytest

from nodes.playback import LONGEST_PAUSE, Playback


class Clock:
    """Passes while somebody sleeps, and not else."""

    def __init__(self) -> None:
        self.now = 500.0

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


def played(timestamps: list[float]) -> tuple[list[float], list[str]]:
    """When each frame came, and what was warned of."""
    clock, said = Clock(), list[str]()
    playback, came = Playback(said.append, lambda: clock.now, clock.sleep), []
    for timestamp in timestamps:
        playback.wait(timestamp)
        came.append(clock.now)
    return came, said


def test_frames_come_at_their_own_pace() -> None:
    came, said = played([7.0, 7.1, 7.1, 9.0, 9.0 + LONGEST_PAUSE])
    np.testing.assert_allclose(np.diff(came), [0.1, 0.0, 1.9, LONGEST_PAUSE])
    assert said == []


@pytest.mark.parametrize("step", [1.7e9, LONGEST_PAUSE + 1.0, -50.0])
def test_a_clock_that_was_set_is_passed_over(step: float) -> None:
    recorded = [100.0 + i / 10 + (step if i >= 5 else 0.0) for i in range(10)]
    came, said = played(recorded)
    np.testing.assert_allclose(np.diff(came), 0.1, atol=1e-6)
    assert len(said) == 1
    assert "after the usual interval" in said[0]
