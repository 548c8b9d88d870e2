"""The launcher as a user runs it: real processes, signals, exit codes, and nothing left behind."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from nodes.runtime.transport import create_keys
from tests.support.launches import Launch, launch
from tests.support.patience import LONG, until

pytestmark = pytest.mark.slow

__all__ = ["launch"]  # the fixture


def sink(output: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((output / "sink.json").read_text())
    return content


def test_everything_arrives_and_the_run_leaves_its_files(launch: type[Launch]) -> None:
    run = launch("source.count=40", "relay.stride=2", "buffer=2")
    code, out, _ = run.finish()
    assert code == 0, out
    arrived = sink(run.output)
    assert arrived["keyframes"] == list(range(0, 40, 2))
    assert arrived["truths"] == list(range(40))
    assert arrived["poses"] == 1
    upstream = arrived["upstream"]
    assert upstream["source"] == {"frames": 40}
    assert upstream["relay"]["keyframes"] == 20
    saved = yaml.safe_load((run.output / "config.yaml").read_text())
    assert saved["source"]["count"] == 40
    assert saved["relay"]["reads"] == {"Frame": "source"}
    assert sorted(path.name for path in (run.output / "logs").iterdir()) == ["relay.log", "sink.log", "source.log"]
    assert str(run.output) in out


def test_over_tcp(launch: type[Launch]) -> None:
    run = launch("transport=tcp", "source.count=20")
    assert run.finish()[0] == 0
    assert sink(run.output)["keyframes"] == list(range(20))


def test_beyond_loopback_only_with_keys(launch: type[Launch], tmp_path: Path) -> None:
    code, _, err = launch("transport=tcp", "host=0.0.0.0").finish()
    assert code == 2
    assert "keys=DIR" in err
    code, _, err = launch("transport=tcp", f"keys={tmp_path}").finish()
    assert code == 2
    assert "no keys at" in err
    create_keys(tmp_path / "keys")
    run = launch("transport=tcp", f"keys={tmp_path / 'keys'}", "source.count=3")
    assert run.finish()[0] == 0
    assert sink(run.output)["keyframes"] == [0, 1, 2]


def test_in_one_process(launch: type[Launch]) -> None:
    run = launch("--inline", "source.count=6")
    assert run.finish()[0] == 0
    assert sink(run.output)["keyframes"] == list(range(6))
    assert not (run.output / "logs").exists()


def test_threads_and_cores_reach_the_node(launch: type[Launch]) -> None:
    run = launch("sink.threads=3", "source.count=0", "source.period=0.02", "relay.cpu=[0]")
    run.wait_until_running()
    assert run.node("relay").cpu_affinity() == [0]
    run.ctrl_c()
    assert run.finish()[0] == 0
    assert sink(run.output)["threads"] == "3"


def test_a_refused_command_line_starts_nothing(launch: type[Launch]) -> None:
    run = launch("relay.strid=3")
    code, _, err = run.finish()
    assert code == 2
    assert "did you mean stride" in err
    assert "Traceback" not in err
    assert not run.output.exists()


def test_a_failing_node_stops_the_graph_and_its_traceback_is_last(launch: type[Launch]) -> None:
    run = launch("relay.fail_at=7", "source.count=0", "source.period=0.01")
    run.wait_until_running()
    until(lambda: "ArithmeticError" in run.log("relay"))
    assert run.goes_down()
    code, _, err = run.finish()
    assert code == 1
    assert re.search(r"^relay failed: ArithmeticError: frame 7 cannot be relayed$", err, re.MULTILINE)
    assert err.rstrip().endswith("ArithmeticError: frame 7 cannot be relayed")
    assert "Traceback" in err


def test_a_killed_node_is_named(launch: type[Launch]) -> None:
    run = launch("relay.kill_at=7", "source.count=0", "source.period=0.01")
    run.wait_until_running()
    until(lambda: len(run.living()) < 3)
    assert run.goes_down()
    code, _, err = run.finish()
    assert code == 1
    assert "relay failed: killed by signal 9" in err


@pytest.mark.parametrize("victim", ["source", "relay", "sink"])
def test_a_node_killed_from_outside_stops_the_graph(launch: type[Launch], victim: str) -> None:
    run = launch("source=live")
    run.wait_until_running()
    run.node(victim).kill()
    assert run.goes_down()
    code, _, err = run.finish()
    assert code == 1
    assert f"{victim} failed: killed by signal 9" in err


def test_the_first_ctrl_c_ends_the_stream_and_finishes_the_run(launch: type[Launch]) -> None:
    run = launch("source=live", "source.best_effort=[]", "relay.seconds=0.02", "relay.tell_at=6")
    until(lambda: "is at frame 6" in run.log("relay"))
    run.ctrl_c()
    code, out, _ = run.finish()
    assert code == 0
    assert "Ctrl-C" in out
    arrived = sink(run.output)
    sent = arrived["upstream"]["source"]["frames"]  # all of it went all the way; the last truth may be cut off
    assert arrived["keyframes"] == list(range(sent))
    assert arrived["truths"] in (list(range(sent)), list(range(sent - 1)))
    assert sent > 5
    said = f"the stream was ended by Ctrl-C after {sent} frames"
    assert run.report()["cut_off"] == {"source": said}
    assert f"warning: source: {said}\n" in out
    assert re.search(rf"^source +{said}$", out, re.MULTILINE)


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0])
def test_a_second_ctrl_c_stops_everything(launch: type[Launch], delay: float) -> None:
    run = launch("source.count=100", "relay.seconds=1")
    run.wait_until_running()
    run.ctrl_c()
    run.wait_until_it_says("Ctrl-C: the stream ends here")
    time.sleep(delay)
    run.ctrl_c()
    assert run.goes_down()
    code, out, _ = run.finish()
    assert code == 130
    assert "stopped" in out
    assert (run.report()["finished"], run.report()["reason"]) == (False, "stopped by Ctrl-C")


@pytest.mark.parametrize("delay", [0.6, 1.2, 1.8])
def test_ctrl_c_while_starting(launch: type[Launch], delay: float) -> None:
    run = launch("source=live")
    time.sleep(delay)
    run.ctrl_c()
    code, _, err = run.finish()
    assert code in (0, 130, -signal.SIGINT), err


INTERRUPTED = """
import os, runpy, signal, sys
del sys.argv[:2]
sys.path.insert(0, os.path.dirname(os.path.dirname(sys.argv[0])))
import launch.supervise as supervise

class Interrupted(supervise.Child):
    def __init__(self, *given):
        super().__init__(*given)
        if not os.path.exists("interrupted"):
            open("interrupted", "w").close()
            os.kill(os.getpid(), signal.SIGINT)

supervise.Child = Interrupted
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_ctrl_c_between_the_starts_of_two_nodes_stops_the_one_that_runs(tmp_path: Path) -> None:
    """Nobody will ever read what it sends: it must not be waited for."""
    run = Launch(tmp_path, "source=live", prefix=[sys.executable, "-c", INTERRUPTED])
    try:
        code, out, _ = run.finish()
    finally:
        run.kill()
    assert (tmp_path / "interrupted").exists()
    assert [log.stem for log in (run.output / "logs").iterdir()] == ["source"]
    assert code == 130
    assert "stopped by Ctrl-C" in out


def test_a_node_that_ignores_sigterm_is_killed(launch: type[Launch]) -> None:
    run = launch("source=live", "source.best_effort=[]", "relay.hang_at=3")
    run.wait_until_running()
    until(lambda: "hangs" in run.log("relay"))
    run.ctrl_c()
    run.wait_until_it_says("Ctrl-C: the stream ends here")
    run.ctrl_c()
    assert run.goes_down()
    assert run.finish()[0] == 130


def test_sigterm_for_the_launcher_takes_the_nodes_along(launch: type[Launch]) -> None:
    run = launch("source=live")
    run.wait_until_running()
    run.process.send_signal(signal.SIGTERM)
    assert run.goes_down()
    assert run.finish()[0] == 128 + signal.SIGTERM


def test_no_node_outlives_a_launcher_that_was_killed(launch: type[Launch]) -> None:
    run = launch("source=live")
    run.wait_until_running()
    run.process.kill()
    assert run.goes_down()
    assert run.nodes() == []


def test_an_external_node_is_run_by_hand(launch: type[Launch]) -> None:
    run = launch("relay=external", "source.count=10")
    assert run.process.stdout is not None
    command = ""
    for line in run.process.stdout:
        if "-m nodes" in line:
            command = line.strip()
            break
    by_hand = subprocess.run(command, shell=True, timeout=LONG, check=False, capture_output=True)
    assert by_hand.returncode == 0, by_hand.stderr
    assert run.finish()[0] == 0
    assert sink(run.output)["keyframes"] == list(range(10))


def test_a_sweep_gives_each_job_its_own_output(launch: type[Launch]) -> None:
    run = launch("-m", "relay.stride=1,2", "source.count=4")
    code, out, _ = run.finish()
    assert code == 0, out
    assert sink(run.output / "0")["keyframes"] == [0, 1, 2, 3]
    assert sink(run.output / "1")["keyframes"] == [0, 2]


def test_a_sweep_on_a_cluster_does_the_same(launch: type[Launch]) -> None:
    run = launch("-m", "hydra/launcher=submitit_local", "relay.stride=1,2", "source.count=4")  # Slurm's, on one machine
    code, out, err = run.finish()
    assert code == 0, out + err
    assert sink(run.output / "0")["keyframes"] == [0, 1, 2, 3]
    assert sink(run.output / "1")["keyframes"] == [0, 2]


def test_a_sweep_goes_on_after_a_failure_and_says_so_at_the_end(launch: type[Launch]) -> None:
    run = launch("-m", "relay.fail_at=1,null", "source.count=4")
    code, _, err = run.finish()
    assert code == 1
    assert err.endswith("\nerror: job 0 ended with code 1\n")
    assert "RunFailed" not in err
    assert sink(run.output / "1")["keyframes"] == [0, 1, 2, 3]
