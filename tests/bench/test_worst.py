"""The benchmark of a run's worst frame looks at all frames, not at the held-out ones."""

from __future__ import annotations

from bench.faults.worst import rows
from mvsgs_core.evaluation.scoring import Score, summarize


def test_one_bad_last_frame_misses_both_goals() -> None:
    def score(index: int, psnr: float, coverage: float = 1.0) -> Score:
        return Score(index, index % 5 == 1, {"psnr": psnr, "ssim": 0.95, "lpips": None}, coverage)

    good = [score(k, 33.0 + 0.1 * k) for k in range(9)]
    found = rows("room", summarize([*good, score(9, 20.3, 0.94)]))
    assert [row.met for row in found] == [None, False, False]
    assert "frame 9" in found[0].unit
    assert [row.met for row in rows("room", summarize(good))] == [None, True, True]
