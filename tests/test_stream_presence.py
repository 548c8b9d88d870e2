"""A sender that gives frames is there, although none of them can be used."""

from __future__ import annotations

from mvsgs_core.stats import Stats
from nodes.stream_presence import Presence


def test_frames_that_are_left_out_end_a_silence() -> None:
    now = 0.0
    stats = Stats()
    presence = Presence(stats, "it", 60.0, lambda: now)
    for tick in range(100):  # waited for since 0 all the time: each frame is left out
        now = 0.1 * tick
        if tick % 2:
            presence.wait(0.0)
        else:
            presence.came()
    assert not stats.warnings
    now += 2.5
    presence.wait(0.0)
    assert stats.counts["lost"] == 1
