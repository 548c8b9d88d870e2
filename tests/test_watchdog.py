"""Which nodes the watchdog gives up, and when, by a clock of the test's own."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from launch.settings import Supervise
from launch.watchdog import STARTING_SECONDS, Watchdog

LIMITS = Supervise(silent=1.0, dead=2.5)


def given_up_after(tmp_path: Path, state: str, frozen: bool) -> tuple[float, str]:
    """Seconds of silence until a node in that state is given up, and the reason."""
    (tmp_path / "relay.log").write_text("")
    child: Any = SimpleNamespace(
        name="relay",
        running=True,
        frozen=frozen,
        heard=0.0,
        moved=0.0,
        log=tmp_path / "relay.log",
        process=SimpleNamespace(pid=1),
        status=SimpleNamespace(state=state, doing="", received=(), topic=""),
        send=lambda number: None,
    )
    now = 0.0
    watchdog = Watchdog(LIMITS, lambda note: None, clock=lambda: now)
    while now < 60:
        if given_up := watchdog.look([child]):
            return now, given_up[1]
        now += 0.25
    raise AssertionError("never given up")


@pytest.mark.parametrize(("state", "more"), [("starting", STARTING_SECONDS), ("running", 0.0)])
def test_a_node_that_loads_its_libraries_may_be_silent_for_longer(tmp_path: Path, state: str, more: float) -> None:
    after, reason = given_up_after(tmp_path, state, frozen=False)
    assert after == pytest.approx(LIMITS.dead + more, abs=0.5)
    assert "it hangs" in reason


@pytest.mark.parametrize("state", ["starting", "running"])
def test_a_node_that_was_stopped_by_a_signal_loads_nothing(tmp_path: Path, state: str) -> None:
    after, reason = given_up_after(tmp_path, state, frozen=True)
    assert after == pytest.approx(LIMITS.dead, abs=0.5)
    assert "it was stopped by a signal" in reason
