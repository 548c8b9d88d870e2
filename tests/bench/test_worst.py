"""The benchmark of a run's worst frame looks at all frames, not at the held-out ones."""

from __future__ import annotations

from bench.faults.worst import rows
from mvsgs_core.evaluation.scoring import Score, summarize


def test_one_bad_last_frame_misses_both_goals() -> None:
    good = [Score(k, k % 5 == 1, 33.0 + 0.1 * k, 0.95, None, 1.0) for k in range(9)]
    found = rows("room", summarize([*good, Score(9, False, 20.3, 0.8, None, 0.94)]))
    assert [row.met for row in found] == [None, False, False]
    assert "frame 9" in found[0].unit
    assert [row.met for row in rows("room", summarize(good))] == [None, True, True]
