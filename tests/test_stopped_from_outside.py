"""Runs that are stopped by signals from outside save what they have, whoever else is told and however often."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.support.launches import DOWN, Launch, gone, launch, lives
from tests.support.patience import Stopwatch

pytestmark = pytest.mark.slow

__all__ = ["launch"]  # the fixture

STREAM = ("source.count=0", "source.period=0.01")
SLOW_TO_SAVE = (*STREAM, "relay._target_=tests.support.fake_graph.slow_stages.SlowToSave")


def test_a_stage_that_is_ended_from_outside_saves_what_it_has(launch: type[Launch], tmp_path: Path) -> None:
    """Its launcher hears of it, and tells all that still run: it must not tell the one that saves to be gone."""
    saved = tmp_path / "saved"
    run = launch(*SLOW_TO_SAVE, f"relay.saved={saved}")
    run.wait_until_running()
    run.node("relay").terminate()
    assert run.goes_down()
    code, _, err = run.finish()
    assert code == 1
    assert "relay failed: stopped (SIGTERM)" in err
    assert saved.read_text() == "stopped (SIGTERM)"


def test_a_service_that_is_stopped_saves_what_it_has(launch: type[Launch], tmp_path: Path) -> None:
    """As systemd and Slurm do it: launcher and nodes are told at once."""
    saved = tmp_path / "saved"
    run = launch(*SLOW_TO_SAVE, f"relay.saved={saved}")
    run.wait_until_running()
    for process in (run.process.pid, *run.nodes()):
        os.kill(process, signal.SIGTERM)
    assert run.goes_down()
    code, out, _ = run.finish()
    assert (code, "stopped by SIGTERM" in out) == (128 + signal.SIGTERM, True)
    assert run.report()["reason"] == "stopped by SIGTERM"
    assert saved.read_text() == "stopped (SIGTERM)"


def test_a_neighbor_that_is_told_first_is_not_what_stops_a_node(launch: type[Launch], tmp_path: Path) -> None:
    """Whoever tells the processes of a service one by one may be slow: the first is gone before the next one hears."""
    saved = tmp_path / "saved"
    run = launch(*SLOW_TO_SAVE, f"relay.saved={saved}")
    run.wait_until_running()
    relay, sink = run.node("relay"), run.node("sink")
    run.process.send_signal(signal.SIGSTOP)  # it must not tell them before
    sink.terminate()
    assert gone([sink], DOWN)
    relay.terminate()
    assert gone([relay], DOWN)
    run.process.send_signal(signal.SIGTERM)
    run.process.send_signal(signal.SIGCONT)
    run.finish()
    assert saved.read_text() == "stopped (SIGTERM)"


def test_a_node_cannot_be_told_to_stop_so_often_that_it_never_does(launch: type[Launch]) -> None:
    run = launch(*STREAM, "relay.seconds=1000")
    run.wait_until_running()
    relay, watch = run.node("relay"), Stopwatch()
    while lives(relay) and watch.within(DOWN):
        with suppress(psutil.NoSuchProcess):
            relay.terminate()
        time.sleep(0.1)
    assert not lives(relay)
    assert run.finish()[0] == 1


@pytest.mark.skipif(signal.getsignal(signal.SIGHUP) == signal.SIG_IGN, reason="these outlive their terminal: nohup")
def test_a_run_ends_with_its_terminal(launch: type[Launch]) -> None:
    run = launch(*STREAM)
    run.wait_until_running()
    run.process.send_signal(signal.SIGHUP)
    assert run.goes_down()
    code, out, _ = run.finish()
    assert (code, "stopped by SIGHUP" in out) == (128 + signal.SIGHUP, True)
