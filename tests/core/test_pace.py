"""How much effort keyframes get: a stage with a simulated clock."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.pace import HORIZON, Effort, Pace
from mvsgs_core.stats import Stats

EFFORTS = (Effort("full", 1.0), Effort("half", 0.4), Effort("small", 0.1), Effort("none", 0.01, telling=False))


class Stage:
    """Serves keyframes in turn, alone on a core, each in `seconds` times the cost of its effort."""

    def __init__(self, seconds: float, share: float = 1.0) -> None:
        self.now = 0.0
        self.seconds = seconds
        self.pace = Pace(EFFORTS, share, Stats(clock=lambda: self.now))
        self.efforts: list[int] = []
        self.delays: list[float] = []  # s from a keyframe's coming to its end
        self.busy = 0.0

    def serve(self, times: list[float]) -> None:
        """Keyframes that come at these times, seconds."""
        for k, time in enumerate(times):
            self.now = max(self.now, time)
            self.pace.waiting = lambda k=k: sum(other <= self.now for other in times[k + 1 :])  # type: ignore[misc]
            self.pace.came(time)
            with self.pace.spend() as effort:
                self.now += self.seconds * EFFORTS[effort].cost
                self.busy += self.seconds * EFFORTS[effort].cost
            self.efforts.append(effort)
            self.delays.append(self.now - time)


def every(seconds: float, count: int, first: float = 0.0) -> list[float]:
    return [first + k * seconds for k in range(count)]


def test_where_there_is_time_for_it_everything_is_done() -> None:
    stage = Stage(seconds=0.15)
    stage.serve(every(0.2, 40))
    assert stage.efforts == [1] + [0] * 39  # the first tells what it costs
    assert sum(stage.pace.log.skipped.values()) == 1


@pytest.mark.parametrize("seconds", [0.3, 0.6, 3.0, 10.0])
def test_no_keyframe_waits_for_long_however_slow_the_machine(seconds: float) -> None:
    stage = Stage(seconds)
    stage.serve(every(0.2, 200))
    settled = stage.delays[60:]
    assert max(settled) < 2.0 * HORIZON
    assert np.median(settled) < HORIZON
    assert sum(stage.pace.log.skipped.values()) == sum(effort > 0 for effort in stage.efforts)  # each is told


def test_no_more_than_its_share_is_taken() -> None:
    stage = Stage(seconds=0.3, share=0.5)
    stage.serve(every(0.2, 200))
    assert stage.busy < 0.55 * stage.now
    assert stage.busy > 0.15 * stage.now  # and what there is, is spent


def test_a_burst_is_worked_off_and_effort_comes_back() -> None:
    stage = Stage(seconds=0.15)
    stage.serve([*every(0.2, 20), *every(0.02, 20, first=4.0), *every(0.2, 40, first=4.5)])
    assert max(stage.efforts[20:40]) > 0
    assert max(stage.delays) < 1.5 * HORIZON
    assert stage.efforts[-10:] == [0] * 10


def test_a_pause_of_the_camera_is_no_slow_camera() -> None:
    stage = Stage(seconds=0.3)
    stage.serve(every(0.2, 30))
    before = stage.pace.interval
    stage.serve(every(0.2, 5, first=stage.now + 60.0))
    assert stage.pace.interval == pytest.approx(before)


def test_a_machine_that_becomes_free_is_used_again() -> None:
    stage = Stage(seconds=30.0)
    stage.serve(every(0.2, 50))
    assert stage.efforts[-1] == 3
    stage.seconds = 0.15
    stage.serve(every(0.2, 400, first=stage.now + 0.2))
    assert stage.efforts[-1] == 0


def test_only_the_efforts_that_may_be_are_made() -> None:
    stage = Stage(seconds=0.6)
    stage.pace = Pace(EFFORTS, 1.0, stage.pace.log, only=(0, 3))
    stage.serve(every(0.2, 50))
    assert set(stage.efforts) == {0, 3}
    for only in ((), (4,), (-1,)):
        with pytest.raises(ValueError, match="3: none"):
            Pace(EFFORTS, 1.0, only=only)
    with pytest.raises(ValueError, match="above 0"):
        Pace(EFFORTS, 0.0)


def test_a_slow_camera_gets_all_effort() -> None:
    stage = Stage(seconds=0.6)
    stage.serve(every(1.0, 20))
    assert set(stage.efforts[1:]) == {0}


def test_where_there_is_time_for_work_on_some_keyframes_alone_it_is_done_on_these() -> None:
    stage = Stage(seconds=4.0, share=0.5)
    stage.serve(every(0.2, 300))
    worked = np.flatnonzero(np.array(stage.efforts[50:]) == 2)
    assert 4 <= np.median(np.diff(worked)) <= 10  # 0.4 s each, and 0.04 s on each of the others, of 0.1 s
    assert stage.busy < 0.7 * stage.now
