"""What befalls nodes during a run: who fails alone, who is only slow, who hangs, and what is left and said."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from pathlib import Path

import pytest

from launch.status import NodeStatus
from launch.summary import summary
from tests.support.launches import DOWN, Launch, launch
from tests.support.patience import LONG, until

pytestmark = pytest.mark.slow

__all__ = ["launch"]  # the fixture

STREAM = ("source.count=150", "source.period=0.01")
SHORT = ("supervise.silent=1.0", "supervise.dead=2.5")
SECONDS = r"[1-9]\d* s"  # as many as the machine made of it: test_watchdog.py counts them by a clock of its own


def test_an_observer_that_is_killed_fails_alone_and_is_named_at_once_and_at_the_end(launch: type[Launch]) -> None:
    run = launch("sink.observer=true", *STREAM)
    run.wait_until_running()
    run.node("sink").kill()
    code, out, err = run.finish()
    assert code == 4, err
    assert "sink failed: killed by signal 9" in out
    assert "the run goes on without it" in out
    assert out.rstrip().splitlines()[-1].startswith("the map is finished, but sink failed: killed by signal 9")
    assert "done" in (run.output / "logs" / "relay.log").read_text()
    assert run.report()["observers"]["sink"].startswith("killed by signal 9")
    assert run.report()["map"] == "finished"


def test_an_observer_that_fails_before_the_start_fails_alone(launch: type[Launch]) -> None:
    run = launch("sink.observer=true", "sink.refuse=true", "source.count=5")
    code, out, err = run.finish()
    assert code == 4, err
    assert "sink failed: OSError: [Errno 28] No space left on device" in out
    assert "in __init__" in err
    assert "done" in (run.output / "logs" / "relay.log").read_text()


@pytest.mark.parametrize("how", ["stopped by a signal", "hanging in its work"])
def test_an_observer_that_hangs_is_given_up_and_its_senders_go_on(launch: type[Launch], how: str) -> None:
    stopped = how == "stopped by a signal"
    size = "source.size=[480,640]"  # a few of these fill the edge
    run = launch("sink.observer=true", *STREAM, *SHORT, size, *(() if stopped else ("sink.long=1000",)))
    run.wait_until_running()
    if stopped:
        run.node("sink").suspend()
    code, out, err = run.finish()
    assert code == 4, err
    assert re.search(rf"sink failed: (silent for {SECONDS}: it was stopped|it has held \w+ back for {SECONDS})", out), (
        out
    )
    held = rf"sink has held \w+ back for {SECONDS}; after 2.5 s the run goes on"
    named = rf"sink has been silent for {SECONDS}" if stopped else held
    assert re.search(named, out), out
    assert "done" in (run.output / "logs" / "relay.log").read_text()


def test_a_stage_that_is_stopped_is_named_and_ends_the_run(launch: type[Launch]) -> None:
    run = launch("source.count=0", "source.period=0.01", *SHORT)
    run.wait_until_running()
    run.node("relay").suspend()
    assert run.goes_down(2.5 + DOWN)
    code, out, err = run.finish()
    assert code == 1
    stopped = rf"relay has been silent for {SECONDS}: its process was stopped \(kill -CONT \d+ lets it go on\)"
    assert re.search(stopped, out), out
    assert re.search(rf"relay failed: silent for {SECONDS}: it was stopped by a signal", err), err
    assert run.report() | {"written": ""} == {
        "finished": False,
        "reason": f"relay failed: {run.report()['error']}",
        "failed": "relay",
        "error": run.report()["error"],
        "resume": None,
        "written": "",
    }


def test_a_stage_whose_process_hangs_is_named_with_where_it_stands(launch: type[Launch]) -> None:
    run = launch("source.count=20", "relay.long_at=5", "relay.long=1000", "relay.how=locked", *SHORT)
    code, out, err = run.finish()
    assert code == 1
    assert re.search(rf"relay has been silent for {SECONDS}: its process hangs; after 2.5 s the run ends\.", out), out
    assert "in take" in out
    assert "relay failed: silent for" in err


@pytest.mark.parametrize("how", ["asleep", "busy"])
def test_a_slow_stage_is_not_a_dead_one(launch: type[Launch], how: str) -> None:
    limits = ("supervise.silent=1.5", "supervise.dead=2.0")
    run = launch("source.count=8", "relay.long_at=5", "relay.long=5", f"relay.how={how}", *limits)
    code, out, err = run.finish()
    assert code == 0, out + err
    assert not re.search("relay (has been silent|failed)", out), out
    assert re.search(
        rf"relay has been at the same piece of work for {SECONDS}; it is alive, so it is left alone", out
    ), out


def test_a_launcher_that_was_stopped_itself_takes_nobody_for_dead(launch: type[Launch]) -> None:
    run = launch("source.count=500", "source.period=0.01", *SHORT)
    run.wait_until_running()
    run.process.send_signal(signal.SIGSTOP)
    time.sleep(4.0)
    run.process.send_signal(signal.SIGCONT)
    code, out, err = run.finish()
    assert code == 0, err
    assert not re.search("(source|relay|sink) (has been silent|failed)", out), out


@pytest.mark.parametrize("victim", ["source", "relay", "sink"])
def test_a_stage_ended_from_outside_ends_the_run_in_time(launch: type[Launch], victim: str) -> None:
    run = launch("source=live")
    run.wait_until_running()
    run.node(victim).terminate()
    assert run.goes_down()
    code, out, err = run.finish()
    assert code == 1
    assert f"{victim} failed: stopped (SIGTERM)" in err
    assert out.rstrip().endswith(f"nothing to go on with in {run.output}: run it again")


def test_nodes_share_a_session_so_that_niceness_decides_between_them_but_no_signals(launch: type[Launch]) -> None:
    run = launch(*STREAM)
    run.wait_until_running()
    nodes = [run.node(name).pid for name in ("source", "relay", "sink")]
    assert {os.getsid(pid) for pid in nodes} == {os.getsid(run.process.pid)}
    assert [os.getpgid(pid) for pid in nodes] == nodes  # a terminal's Ctrl-C reaches none of them
    assert run.finish()[0] == 0


def test_an_empty_result_is_no_success(launch: type[Launch]) -> None:
    run = launch("source.count=3", "relay.nothing=too little motion: 0.3 pixels", "sink.observer=true")
    code, out, _ = run.finish()
    assert code == 3
    assert out.rstrip().endswith("nothing to show: relay: too little motion: 0.3 pixels")
    assert run.report()["nothing"] == {"relay": "too little motion: 0.3 pixels"}


def test_what_a_node_says_cannot_steer_the_terminal(launch: type[Launch]) -> None:
    run = launch("source.count=3", 'relay.says="\x1b]0;owned\x07\x1b[2J"')
    code, out, _ = run.finish()
    assert code == 0
    assert "\x1b" not in out
    assert "\x07" not in out
    assert r"warning: relay: \x1b]0;owned\x07\x1b[2J" in out


def test_every_text_of_a_status_is_printable() -> None:
    status = NodeStatus("a")
    line = {"state": "\x1b", "counts": {"\x1b": 1}, "values": {"v": ["\x1b"]}, "traceback": "one\ntwo \x1b\n"}
    status.update(json.dumps(line).encode())
    assert status.state == "\\x1b"
    assert status.counts == {"\\x1b": 1}
    assert status.values == {"v": ["\\x1b"]}
    assert status.traceback == "one\ntwo \\x1b"


def test_one_run_at_a_time_writes_to_a_directory(launch: type[Launch]) -> None:
    first = launch("source=live")
    first.wait_until_running()
    assert first.report()["finished"] is False
    assert "still running" in first.report()["reason"]
    second = launch("source.count=3")
    code, _, err = second.finish()
    assert code == 2
    assert f"another run (process {first.process.pid}) is writing there" in err
    first.ctrl_c()
    assert first.finish()[0] == 0
    assert launch("source.count=3").finish()[0] == 0
    assert not (first.output / ".lock").exists()


def test_an_earlier_runs_results_are_moved_aside_whole(launch: type[Launch], tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "checkpoint").mkdir(parents=True)
    names = ("map.ply", "trajectory.txt", "report.html", "config.yaml", "checkpoint/state")
    for name in names:
        (out / name).write_text(f"# mvsgs of the first: {name}")
    for count in (3, 4):  # the second of these has no map to move: the first one's stays
        assert launch(f"source.count={count}").finish()[0] == 0
        assert not (out / "map.ply").exists()
        assert not (out / "report.html").exists()
        assert not (out / "checkpoint").exists()
        assert not (out / "previous-2").exists()
        for name in names:
            assert (out / "previous" / name).read_text() == f"# mvsgs of the first: {name}"
        assert f"count: {count}" in (out / "config.yaml").read_text()


def test_run_directories_of_killed_launchers_are_removed_by_the_next(launch: type[Launch]) -> None:
    killed = launch("source=live")
    killed.wait_until_running()
    living = launch("source=live", f"output={killed.output}2", sockets=killed.sockets)
    until((Path(f"{killed.output}2") / "logs" / "sink.log").exists)
    killed.process.kill()
    killed.process.wait()
    foreign = killed.sockets / "mvsgs-12345678"  # no launcher's: without its lock
    foreign.mkdir()
    left = {path.name for path in killed.sockets.iterdir()}
    assert len(left) == 3
    third = launch("source.count=3", f"output={killed.output}3", sockets=killed.sockets)
    _, err = third.process.communicate(timeout=LONG)
    assert third.process.returncode == 0, err
    now = {path.name for path in killed.sockets.iterdir()}
    assert len(now) == 2
    assert foreign.name in now
    foreign.rmdir()
    living.ctrl_c()
    assert living.finish()[0] == 0


def test_a_report_is_this_runs_whatever_the_clock_says(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"finished": True, "map": {"splats": 7}}))
    os.utime(report, (1, 1))
    assert "7 splats" in summary(tmp_path)
    report.write_text(json.dumps({"finished": False, "reason": "evaluator failed: disk full"}))
    assert "no report: evaluator failed: disk full" in summary(tmp_path)
