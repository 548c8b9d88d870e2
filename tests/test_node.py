"""Nodes in processes of their own: nothing lost, everything ends, and whatever fails takes the graph down in time."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from launch.ports import free_ports
from mvsgs_core.machine import available_cores
from nodes.runtime.process import parameters
from nodes.runtime.spec import Spec, gone_file
from nodes.runtime.transport import create_keys
from tests.support.patience import LONG, Stopwatch, until
from tests.support.processes import ENVIRONMENT, graph
from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow

DOWN = 5.0  # s in which a graph must be down after a failure


def test_a_diamond_with_a_slow_reader_loses_nothing_and_keeps_the_order() -> None:
    count = 1000
    with graph(buffer=2) as g:
        g.diamond(source={"count": count}, join={"delay": 0.001}, left={"delay": 0.0005})
        assert g.wait() == dict.fromkeys(("join", "left", "right", "source"), 0)
        assert g.joined["received"] == {"Keyframe": list(range(count)), "GroundTruth": list(range(count))}
        assert g.sockets() == []


def test_a_diamond_over_tcp_with_keys(tmp_path: Path) -> None:
    create_keys(tmp_path)
    with graph(ports=free_ports(3), keys=tmp_path) as g:
        g.diamond(source={"count": 50})
        assert set(g.wait().values()) == {0}
        assert g.joined["received"] == {"Keyframe": list(range(50)), "GroundTruth": list(range(50))}


def test_a_node_with_other_keys_is_not_let_in(tmp_path: Path) -> None:
    create_keys(tmp_path / "ours")
    create_keys(tmp_path / "other")
    with graph(ports=free_ports(1), keys=tmp_path / "ours") as g:
        here = "tests.support.sample_nodes"
        g.start("source", f"{here}.Source", {}, {"Frame": 1})
        stranger = g.start("left", f"{here}.Left", {"Frame": "source"}, {}, keys=str(tmp_path / "other"))
        assert stranger.popen.wait(LONG) == 1
        g.processes["source"].wait_for(lambda status: status.get("state") == "waiting")
        g.processes["source"].popen.kill()
        g.wait()
        assert "refused the keys: both ends need the same" in stranger.last["error"]
        assert g.processes["source"].last["state"] == "waiting"


def test_statistics_of_all_nodes_reach_the_end_once() -> None:
    with graph() as g:
        g.diamond(source={"count": 5, "delay": 0.1}, join={"slices": 3})
        g.wait()
        upstream = g.joined["upstream"]
        assert set(upstream) == {"source", "left", "right"}
        assert upstream["source"]["counts"] == {"frames": 5}
        assert upstream["left"]["received"] == {"source.Frame": 5}
        assert upstream["left"]["sent"] == {"Keyframe": 5}
        for stats in upstream.values():
            assert stats["wall_seconds"] > 0
            assert stats["cpu_seconds"] > 0
            assert stats["peak_bytes"] > 10**7
        states = [line["state"] for line in g.processes["left"].lines]
        assert list(dict.fromkeys(states)) == ["starting", "waiting", "running", "ending", "done"]
        last = g.processes["left"].last
        assert last["in"] == {"source.Frame": 5}
        assert last["out"] == {"Keyframe": 5}
        assert last["bytes"] > 10**7
        assert g.processes["join"].last["counts"]["slices"] >= 3  # background work went on until there was none


def test_a_failing_node_says_why_and_takes_the_others_down() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6}, left={"fail_at": 20})
        codes = g.wait()
        assert codes == dict.fromkeys(("join", "left", "right", "source"), 1)
        last = g.processes["left"].last
        assert (last["state"], last["error"], last["peer"]) == ("failed", "RuntimeError: no pose for frame 20", False)
        assert "in on_frame" in last["traceback"]
        assert "and a second line" in g.processes["left"].log.read_text()
        assert g.processes["source"].last["peer"]
        assert g.sockets() == []


@pytest.mark.parametrize("victim", ["source", "left", "join"])
def test_a_killed_node_is_noticed_by_all_in_time(victim: str) -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6}, join={"delay": 0.002})
        g.processes["join"].wait_for(lambda status: sum(status.get("in", {}).values()) > 20)
        g.processes[victim].popen.kill()
        watch = Stopwatch()
        codes = g.wait()
        assert watch.within(DOWN)
        assert codes.pop(victim) == -signal.SIGKILL
        assert set(codes.values()) == {1}
        assert any("PeerLost" in g.processes[name].last.get("error", "") for name in codes)


def test_sigint_ends_a_source_and_the_graph_finishes_with_what_it_has() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6, "delay": 0.001})
        time.sleep(random.uniform(0.0, 1.0))  # from before the imports are done to the middle of the stream
        for process in g.processes.values():
            process.popen.send_signal(signal.SIGINT)
        for process in g.processes.values():  # the promise counts from here: a busy machine takes long to start four
            process.wait_for(lambda status: status.get("state") not in (None, "starting"))
        assert set(g.wait(DOWN).values()) == {0}
        received = g.joined["received"]
        assert received["Keyframe"] == received["GroundTruth"] == list(range(len(received["Keyframe"])))
        assert g.sockets() == []


def test_sigint_ends_a_source_whose_read_hangs() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6, "hang_at": 7})
        g.processes["join"].wait_for(lambda status: sum(status.get("in", {}).values()) == 14)
        g.processes["source"].popen.send_signal(signal.SIGINT)
        assert set(g.wait(DOWN).values()) == {0}
        assert g.joined["received"]["Keyframe"] == list(range(7))
        assert "did not return" in g.joined["upstream"]["source"]["warnings"][0]


def test_a_source_that_fails_to_read_is_a_failure_of_the_graph() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6, "fail_at": 3})
        assert set(g.wait().values()) == {1}
        assert [g.processes["source"].last[what] for what in ("error", "traceback")] == ["frame 3 cannot be read", ""]


def test_sigterm_lets_a_node_save_what_it_has() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6})
        join = g.processes["join"]
        join.wait_for(lambda status: sum(status.get("in", {}).values()) > 20)
        join.popen.send_signal(signal.SIGTERM)
        watch = Stopwatch()
        assert g.wait()["join"] == 128 + signal.SIGTERM
        assert watch.within(DOWN)
        assert (join.last["state"], join.last["error"]) == ("stopped", "stopped (SIGTERM)")
        saved = g.aborted
        assert saved["reason"] == "stopped (SIGTERM)"
        assert saved["received"]["Keyframe"] == list(range(len(saved["received"]["Keyframe"])))
        assert sum(map(len, saved["received"].values())) > 20


@pytest.mark.parametrize("busy", [{"left": {"delay": 100.0}}, {"join": {"delay": 100.0}}])
def test_sigterm_stops_a_node_that_waits_for_others(busy: dict[str, dict[str, float]]) -> None:
    """For a message that doesn't come, or for a reader that takes none: at once, not when that one goes on."""
    with graph() as g:
        g.diamond(source={"count": 10**6}, **busy)
        waits = "join" if "left" in busy else "left"
        g.processes["left"].wait_for(lambda status: sum(status.get("in", {}).values()) >= 1)
        if waits == "left":
            left = g.processes["left"]
            until(lambda: (left.last.get("doing"), left.last.get("topic")) == ("held back", "left.Keyframe"))
        watch = Stopwatch()
        g.processes[waits].popen.send_signal(signal.SIGTERM)
        assert g.processes[waits].popen.wait(LONG) == 128 + signal.SIGTERM
        assert watch.within(2.0)


def test_sigterm_stops_a_node_whose_readers_never_come() -> None:
    with graph() as g:
        left = g.start("left", "tests.support.sample_nodes.Left", {}, {"Keyframe": 1})
        left.wait_for(lambda status: status.get("state") == "waiting")
        watch = Stopwatch()
        left.popen.send_signal(signal.SIGTERM)
        assert left.popen.wait(LONG) == 128 + signal.SIGTERM
        assert watch.within(2.0)


def test_a_node_that_reaches_no_safe_point_after_sigterm_is_gone_all_the_same() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6}, left={"delay": 100.0})
        g.processes["left"].wait_for(lambda status: sum(status.get("in", {}).values()) == 1)
        watch = Stopwatch()
        g.processes["left"].popen.send_signal(signal.SIGTERM)
        assert g.processes["left"].popen.wait(LONG) == -signal.SIGALRM
        assert watch.within(DOWN)


def test_a_node_that_takes_too_long_to_save_is_gone_all_the_same() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6, "fail_at": 20}, join={"abort_seconds": 100.0})
        assert g.wait() == {"source": 1, "left": 1, "right": 1, "join": -signal.SIGALRM}


def test_a_lost_neighbor_lets_a_node_save_what_it_has() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6}, left={"die_at": 20})
        g.wait()
        assert "PeerLost" in g.aborted["reason"]
        saved = g.aborted["received"]["Keyframe"]  # less what was under way
        assert saved == list(range(len(saved)))


def test_where_its_threads_stand_is_asked_for_by_a_signal() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6}, left={"delay": 100.0})
        left = g.processes["left"]
        left.wait_for(lambda status: sum(status.get("in", {}).values()) == 1)
        left.popen.send_signal(signal.SIGUSR1)
        until(lambda: "in on_frame" in left.log.read_text())
        assert left.popen.poll() is None


def test_a_slow_best_effort_reader_never_holds_its_sender_back() -> None:
    with graph() as g:
        here = "tests.support.sample_nodes"
        g.start("viewer", f"{here}.Left", {"Frame": "source?"}, {}, {"delay": 0.3})
        g.start("source", f"{here}.Source", {}, {"Frame": 1}, {"count": 200, "delay": 0.002})
        assert set(g.wait().values()) == {0}
        source, viewer = (g.processes[name].last for name in ("source", "viewer"))
        assert source["out"] == {"Frame": 200}
        assert 1 <= viewer["in"]["source.Frame"] < 20
        running = [line for line in g.processes["source"].lines if line["state"] == "running"]
        assert running  # it ran for 0.4 s and more, not for the reader's 60


def test_a_frozen_best_effort_reader_never_holds_its_sender_back() -> None:
    with graph() as g:
        here = "tests.support.sample_nodes"
        viewer = g.start("viewer", f"{here}.Left", {"Frame": "source?"}, {}, {})
        source = g.start("source", f"{here}.Source", {}, {"Frame": 1}, {"count": 1000, "delay": 0.001})
        viewer.wait_for(lambda status: sum(status.get("in", {}).values()) > 3)
        viewer.popen.send_signal(signal.SIGSTOP)
        source.wait_for(lambda status: status.get("state") == "ending")
        assert source.last["out"] == {"Frame": 1000}
        assert source.popen.wait(10) == 0  # its goodbye is not waited for without end


def test_an_observer_that_is_killed_takes_nobody_along() -> None:
    """While its sender is held back by it, at that."""
    with graph() as g:
        here = "tests.support.sample_nodes"
        frames = {"observers": ["watcher"], "address": g.address("source.Frame"), "type": "Frame", "readers": 1}
        g.start("left", f"{here}.Left", {"Frame": "source"}, {})
        watcher = g.start("watcher", f"{here}.Right", {"Frame": "source"}, {}, observer=True)
        source = g.start("source", f"{here}.Source", {}, {}, {"count": 2000, "delay": 0.002}, outputs=[frames])
        watcher.wait_for(lambda status: sum(status.get("in", {}).values()) > 3)
        watcher.popen.send_signal(signal.SIGSTOP)
        until(lambda: (source.last.get("doing"), source.last.get("topic")) == ("held back", "source.Frame"))
        watcher.popen.kill()
        assert g.wait() == {"left": 0, "watcher": -signal.SIGKILL, "source": 0}
        assert g.processes["left"].last["in"] == {"source.Frame": 2000}


def test_an_observer_that_never_comes_is_waited_for_until_it_is_known_to_be_gone() -> None:
    with graph() as g:
        here = "tests.support.sample_nodes"
        frames = {"observers": ["watcher"], "address": g.address("source.Frame"), "type": "Frame", "readers": 1}
        left = g.start("left", f"{here}.Left", {"Frame": "source"}, {})
        source = g.start("source", f"{here}.Source", {}, {}, {"count": 3}, outputs=[frames])
        left.wait_for(lambda status: status.get("state") == "running")
        time.sleep(0.5)
        assert source.last["state"] == "waiting"
        gone_file(g.directory, "watcher").touch()
        assert set(g.wait().values()) == {0}
        assert left.last["in"] == {"source.Frame": 3}


def test_a_node_that_yields_what_it_does_not_declare_fails() -> None:
    with graph() as g:
        g.start("left", "tests.support.sample_nodes.Wrong", {"Frame": "source"}, {})
        g.start("source", "tests.support.sample_nodes.Source", {}, {"Frame": 1}, {"count": 10**6})
        assert set(g.wait().values()) == {1}
        assert "yields a Frame, but its annotations say Keyframe" in g.processes["left"].last["error"]


@pytest.mark.parametrize(
    ("target", "config", "error"),
    [
        ("tests.support.sample_nodes.Nothing", {}, "is no node"),
        ("tests.no_such_module.Left", {}, "ModuleNotFoundError"),
        (
            "tests.support.sample_nodes.Left",
            {"dely": 1},
            "left.dely: tests.support.sample_nodes.Left has no parameter 'dely' (did you mean delay?)",
        ),
        ("tests.support.sample_nodes.Left", {"delay": "long"}, "left.delay=long: must be float"),
    ],
)
def test_a_wrong_specification_is_refused(target: str, config: dict[str, object], error: str) -> None:
    with graph() as g:
        g.start("left", target, {"Frame": "source"}, {}, config)
        assert g.wait() == {"left": 1}
        assert error in g.processes["left"].last["error"]


def test_a_file_that_is_no_specification_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "spec.json"
    for text, error in (
        ("{", "Expecting"),
        ('{"name": "a"}', "target must be given"),
        ("[1]", "must be a JSON object"),
    ):
        path.write_text(text)
        done = subprocess.run([sys.executable, "-m", "nodes", path], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 2
        assert error in done.stderr


def test_without_a_word_about_threads_a_node_has_all_cores() -> None:
    spec = Spec("left", "x.Left", {"threads": None}, (), ())
    assert parameters(spec) == {"threads": available_cores()}
    assert parameters(replace(spec, threads=3)) == {"threads": None}
    assert parameters(replace(spec, config={"delay": 1})) == {"delay": 1}


def test_cores_threads_and_niceness_are_set() -> None:
    core = max(os.sched_getaffinity(0))
    with graph() as g:
        g.start("left", "tests.support.sample_nodes.Left", {"Frame": "source"}, {}, cpu=[core], threads=1, nice=3)
        left = g.processes["left"]
        left.wait_for(lambda status: status.get("state") == "running")
        for task in Path(f"/proc/{left.popen.pid}/task").iterdir():
            assert os.sched_getaffinity(int(task.name)) == {core}
            assert os.getpriority(os.PRIO_PROCESS, int(task.name)) == 3


def test_no_node_outlives_a_killed_launcher() -> None:
    with graph() as g:
        launcher = subprocess.Popen(
            [sys.executable, "-c", _LAUNCHER, str(g.directory)],
            cwd=ROOT,
            env={**os.environ, **ENVIRONMENT},
            stdout=subprocess.PIPE,
        )
        assert launcher.stdout is not None
        with launcher.stdout:
            child = int(launcher.stdout.readline())
        launcher.kill()
        launcher.wait()
        watch = Stopwatch()
        until(lambda: not _alive(child))
        assert watch.within(DOWN)


_LAUNCHER = """
import sys, time
from nodes.runtime.spec import gone_file
from nodes.runtime.transport import create_keys
from tests.support.processes import Graph
g = Graph()
p = g.start("left", "tests.support.sample_nodes.Left", {"Frame": "source"}, {})
p.wait_for(lambda status: status.get("state") == "running")
print(p.popen.pid, flush=True)
time.sleep(100)
"""


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _exercise(rounds: int, count: int) -> None:
    """`python -m tests.test_node ROUNDS COUNT`: the long form of these tests, at random moments."""
    for i in range(rounds):
        with graph(buffer=2) as g:
            g.diamond(source={"count": count}, join={"delay": 0.002})
            codes = g.wait(120)
            kept = g.joined["received"] == {kind: list(range(count)) for kind in ("Keyframe", "GroundTruth")}
            print(f"diamond {i + 1}: {'all in order' if kept else 'LOST'}, {codes}, sockets {g.sockets()}", flush=True)
    for i in range(4 * rounds):
        victim = random.choice(["source", "left", "right", "join"])
        number = random.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
        with graph(buffer=2) as g:
            g.diamond(source={"count": 300}, join={"delay": 0.001})
            if number != signal.SIGINT:  # a node that dies before it has met the others leaves them to the launcher
                for process in g.processes.values():
                    process.wait_for(lambda status: status.get("state") == "running")
            time.sleep(random.uniform(0.0, 1.5))
            g.processes[victim].popen.send_signal(number)
            began = time.monotonic()
            states = [process.last.get("state") for process in g.processes.values()]
            try:
                codes = g.wait(DOWN)
                outcome = f"down after {time.monotonic() - began:.2f} s, {codes}, sockets {g.sockets()}"
            except AssertionError as error:
                outcome = f"FAILED: {error}"
            print(f"{number.name} {i + 1}: {victim} among {states}: {outcome}", flush=True)


if __name__ == "__main__":
    _exercise(int(sys.argv[1]), int(sys.argv[2]))
