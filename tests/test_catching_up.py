"""A live tracker that was at work for long: which of the frames that came meanwhile it takes up."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from msgs import Frame, Trajectory
from mvsgs_core.tracking.phase import Phase
from nodes.catching_up import HOP, KEPT, PASSED_OVER, CatchingUp
from nodes.reader import Reader
from nodes.runtime.transport.publisher import Publisher
from nodes.runtime.transport.readers import NewestReader
from nodes.tracker import Tracker
from tests.support.patience import LONG, until
from tests.support.shared_data import shared

SOLVED = 17  # frame of hololens_000 with which its first keyframes can be solved


def frame(index: int) -> Frame:
    return Frame(index, index / 30, np.zeros((4, 4, 3), np.uint8), np.ones(4))


def taken(waiting: CatchingUp, phase: Phase, follows: Callable[[Frame], bool]) -> list[int]:
    """Indices, until none waits."""
    found = []
    while waiting.behind:
        found.append(waiting.take(phase, follows).index)
    return found


def never(frame: Frame) -> bool:
    return False


def test_the_newest_is_taken_where_the_camera_is_followed_to_it() -> None:
    waiting = CatchingUp()
    waiting.came([frame(k) for k in range(9)])
    assert taken(waiting, Phase.TRACKING, lambda newest: newest.index == 8) == [8]


def test_else_all_are_in_their_order_and_those_that_come_meanwhile() -> None:
    waiting = CatchingUp()
    waiting.came([frame(k) for k in range(3)])
    assert waiting.take(Phase.TRACKING, never).index == 0
    waiting.came([frame(3)])
    assert taken(waiting, Phase.TRACKING, lambda newest: True) == [1, 2, 3], "it was decided when they came"
    waiting.came([frame(4), frame(5)])
    assert taken(waiting, Phase.TRACKING, lambda newest: True) == [5], "and is anew once none waits"


@pytest.mark.parametrize("phase", [Phase.LOST, Phase.RELOCALIZING])
def test_a_lost_camera_is_looked_for_in_the_newest(phase: Phase) -> None:
    waiting = CatchingUp()
    waiting.came([frame(k) for k in range(5)])
    assert waiting.take(Phase.TRACKING, never).index == 0
    assert taken(waiting, phase, never) == [4]


def test_a_start_takes_all_and_asks_nothing() -> None:
    def asked(frame: Frame) -> bool:
        raise AssertionError("there is no map to follow the camera in")

    waiting = CatchingUp()
    waiting.came([frame(k) for k in range(4)])
    assert taken(waiting, Phase.INITIALIZING, asked) == [0, 1, 2, 3]


def test_the_more_wait_the_more_are_passed_over_and_the_oldest_are_let_go() -> None:
    waiting = CatchingUp()
    waiting.came([frame(k) for k in range(KEPT + 10)])
    found = taken(waiting, Phase.TRACKING, never)
    steps = np.diff([9, *found])
    assert found[-1] == KEPT + 9
    assert waiting.passed_over == KEPT + 10 - len(found)
    assert steps[0] == 1 + (KEPT - 1) // HOP
    assert (np.diff(steps) <= 0).all()
    assert steps[-1] == 1


def on_hololens(missed: bool) -> tuple[Tracker, Trajectory]:
    """A tracker that solves its first keyframes for 13 frames' time, in which the head turns on."""
    config = Reader.Config(name="tum", path=str(shared("data/hololens_000")), size=240 * 320, stop=45)
    frames = [m for m in Reader(config).run() if isinstance(m, Frame)]
    node = Tracker(Tracker.Config(realtime=True, share=1.0))

    def idle() -> Iterator[object]:
        while (found := node.on_idle()) is not None:
            yield from found

    for given in frames[: SOLVED + 1]:
        list(node.on_frame(given))
        list(idle())
    assert node.core.phase is Phase.TRACKING
    overtaken = frames[SOLVED + 1 : SOLVED + 14]
    if missed:
        node.missed = lambda kind: overtaken if kind is Frame else []
    for given in frames[SOLVED + 14 :]:
        list(node.on_frame(given))
        node.missed = lambda kind: []
        list(idle())
    return node, next(m for m in node.on_end() if isinstance(m, Trajectory))


@pytest.mark.slow
def test_a_head_that_turns_while_the_start_is_solved_is_followed_on() -> None:
    node, trajectory = on_hololens(missed=True)
    assert node.core.phase is Phase.TRACKING
    assert "relocalized" not in node.stats.counts
    assert node.stats.counts["frames taken up late"] > 3
    assert node.stats.skipped[PASSED_OVER] == 45 - node.stats.counts["frames"]
    assert set(trajectory.segment.tolist()) == {0}
    assert np.isfinite(trajectory.world_from_cam[SOLVED:]).all()
    node, trajectory = on_hololens(missed=False)
    assert node.stats.counts["frames while relocalizing"] > 0, "it is a turn that loses the camera"


@pytest.mark.parametrize("kept", [0, 3, 30])
def test_a_reader_of_the_newest_keeps_what_that_overtook(tmp_path: Path, kept: int) -> None:
    address = f"ipc://{tmp_path}/frames"
    publisher, reader = Publisher(address), NewestReader(address, Frame, missed_kept=kept)
    try:
        until(lambda: publisher.ready(1))
        for index in range(6):
            publisher.send(frame(index))
            until(lambda sent=index + 1: reader.displaced + reader.waiting == sent)
        newest = reader.receive(LONG)
        assert isinstance(newest, Frame)
        assert newest.index == 5
        publisher.send(frame(6))
        until(lambda: reader.waiting == 1)
        assert [m.index for m in reader.missed() if isinstance(m, Frame)] == list(range(5))[5 - min(kept, 5) :]
        assert reader.missed() == []
        assert reader.skipped == 5 - min(kept, 5), "what was given out is read"
        assert reader.received == 1 + min(kept, 5)
        assert isinstance(reader.receive(LONG), Frame)
        assert reader.missed() == []
    finally:
        reader.close()
        publisher.close()
