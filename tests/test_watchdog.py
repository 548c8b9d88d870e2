"""Which nodes the watchdog gives up, and when, by a clock of the test's own."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from launch.settings import Supervise
from launch.watchdog import DUMP_SECONDS, STARTING_SECONDS, Watchdog

LIMITS = Supervise(silent=1.0, dead=2.5)


def node(folder: Path, name: str, **status: Any) -> Any:
    """Stands for the launcher's child of that name."""
    log = folder / f"{name}.log"
    log.write_text("")
    return SimpleNamespace(
        name=name,
        running=True,
        frozen=False,
        heard=0.0,
        moved=0.0,
        log=log,
        process=SimpleNamespace(pid=1),
        status=SimpleNamespace(**{"state": "running", "doing": "", "received": (), "topic": ""} | status),
        send=lambda number: None,
    )


def given_up_after(tmp_path: Path, state: str, frozen: bool) -> tuple[float, str, list[str]]:
    """Seconds of silence until a node in that state is given up, the reason, and what was said before."""
    child, said = node(tmp_path, "relay", state=state), list[str]()
    child.frozen = frozen
    now = 0.0
    watchdog = Watchdog(LIMITS, said.append, clock=lambda: now)
    while now < 60:
        if given_up := watchdog.look([child]):
            return now, given_up[1], said
        now += 0.25
    raise AssertionError("never given up")


@pytest.mark.parametrize(("state", "more"), [("starting", STARTING_SECONDS), ("running", 0.0)])
def test_a_node_that_loads_its_libraries_may_be_silent_for_longer(tmp_path: Path, state: str, more: float) -> None:
    after, reason, _ = given_up_after(tmp_path, state, frozen=False)
    assert after == pytest.approx(LIMITS.dead + more, abs=0.5)
    assert "it hangs" in reason


@pytest.mark.parametrize("state", ["starting", "running"])
def test_a_node_that_was_stopped_by_a_signal_loads_nothing(tmp_path: Path, state: str) -> None:
    after, reason, said = given_up_after(tmp_path, state, frozen=True)
    assert after == LIMITS.dead
    assert reason == "silent for 2 s: it was stopped by a signal"
    assert said == [
        "relay has been silent for 2 s: its process was stopped (kill -CONT 1 lets it go on); after 2.5 s the run ends"
    ]


def test_a_node_that_hangs_is_named_once_it_could_have_said_where(tmp_path: Path) -> None:
    child, said, now = node(tmp_path, "relay"), list[str](), 0.0
    watchdog = Watchdog(LIMITS, said.append, clock=lambda: now)
    while not said:
        now += 0.125
        assert watchdog.look([child]) is None
    assert now == LIMITS.silent + DUMP_SECONDS
    assert said == ["relay has been silent for 2 s: its process hangs; after 2.5 s the run ends"]


def test_a_slow_node_is_named_once_and_never_given_up(tmp_path: Path) -> None:
    child, said, named = node(tmp_path, "relay", doing="working", received=("source.Frame",)), list[str](), 0.0
    now = 0.0
    watchdog = Watchdog(LIMITS, said.append, clock=lambda: now)
    while now < 60:
        now += 0.25
        child.heard = now
        assert watchdog.look([child]) is None
        named = named or now * bool(said)
    assert named == LIMITS.dead
    assert said == [
        "relay has been at the same piece of work for 2 s; it is alive, so it is left alone (where it stands: "
        f"{child.log})"
    ]


def test_an_observer_that_holds_a_stage_back_is_named_and_given_up_in_time(tmp_path: Path) -> None:
    relay = node(tmp_path, "relay", doing="held back", topic="relay.Keyframe")
    sink = node(tmp_path, "sink", doing="working", received=("relay.Keyframe",))
    said, now = list[str](), 0.0
    watchdog = Watchdog(LIMITS, said.append, observers=("sink",), clock=lambda: now)
    while (given_up := watchdog.look([relay, sink])) is None:
        now += 0.25
        relay.heard = sink.heard = now
        assert bool(said) == (now > LIMITS.silent)
    assert now == LIMITS.dead
    assert given_up == (sink, "it has held relay back for 2 s")
    assert said == [
        f"sink has held relay back for 1 s; after 2.5 s the run goes on without it (where it stands: {sink.log})"
    ]
