"""Stages that are started by hand: what the launcher knows of their end, and how they are ended themselves."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from launch.compose import compose
from launch.specs import addresses, spec
from msgs import End, Frame
from nodes.runtime.transport import NewestReader, Publisher
from nodes.runtime.transport.readers import PEER_GRACE
from tests.support.launches import DOWN, FAKE, Launch, launch
from tests.support.patience import LONG, Stopwatch, until
from tests.support.processes import Graph, Process, graph

pytestmark = pytest.mark.slow

__all__ = ["launch"]  # the fixture

SLOW = "tests.support.fake_graph.slow_stages"
SAMPLE = "tests.support.sample_nodes"


@contextmanager
def by_hand(run: Launch) -> Iterator[subprocess.Popen[bytes]]:
    """The stage that the launcher says is to be started, started."""
    assert run.process.stdout is not None
    command = next(line for line in run.process.stdout if "-m nodes" in line).strip()
    with subprocess.Popen(f"exec env {command}", shell=True, stderr=subprocess.PIPE) as stage:
        try:
            yield stage
        finally:
            stage.kill()


def test_a_run_is_not_finished_where_a_stage_elsewhere_may_still_work(launch: type[Launch], tmp_path: Path) -> None:
    """Nothing here reads what it sends: all others have ended, and it goes on with the map."""
    goes = tmp_path / "goes"
    run = launch("sink=external", f"sink._target_={SLOW}.SlowToEnd", f"sink.goes={goes}", "source.count=5")
    checkpoint = run.output / "checkpoint" / "state-1.npz"
    with by_hand(run) as stage:
        checkpoint.parent.mkdir()
        checkpoint.touch()
        out, _ = run.process.communicate(timeout=LONG)
        assert stage.poll() is None
        goes.touch()
        assert stage.wait(LONG) == 0
    code, _, _ = run.finish()
    said = "sink is external: its end is not known here"
    assert (code, said in out) == (1, True)
    assert out.rstrip().endswith("sink still works, or has ended, where it was started: what it makes is there")
    assert (run.report()["finished"], run.report()["reason"]) == (False, said)
    assert checkpoint.exists()
    assert (run.output / "sink.json").exists()


def test_an_empty_result_is_said_to_be_one_whoever_works_elsewhere(launch: type[Launch]) -> None:
    run = launch("sink=external", "relay.nothing=too little motion: 0.3 pixels", "source.count=3")
    with by_hand(run) as stage:
        out, _ = run.process.communicate(timeout=LONG)
        assert stage.wait(LONG) == 0
    assert run.finish()[0] == 3
    assert "sink still works, or has ended, where it was started" in out
    assert out.rstrip().endswith("nothing to show: relay: too little motion: 0.3 pixels")
    assert run.report()["nothing"] == {"relay": "too little motion: 0.3 pixels"}
    assert run.report()["reason"] == "sink is external: its end is not known here"


def test_a_stage_elsewhere_that_was_read_to_the_end_has_ended_well(launch: type[Launch]) -> None:
    run = launch("relay=external", "source.count=5")
    with by_hand(run) as stage:
        assert stage.wait(LONG) == 0
    assert run.finish()[0] == 0
    assert run.report()["finished"] is True


def test_a_stage_elsewhere_that_dies_in_its_last_work_leaves_no_finished_run(launch: type[Launch]) -> None:
    """Only who watches notices, and would be the one that failed."""
    run = launch("relay=external", f"relay._target_={SLOW}.DiesAtTheEnd", "sink.observer=true", "source.count=5")
    with by_hand(run) as stage:
        assert stage.wait(LONG) == -signal.SIGKILL
    code, out, err = run.finish()
    assert code == 1, out
    assert "the map is finished" not in out
    assert "sink failed: PeerLost: the publisher of relay." in err
    assert (run.report()["finished"], run.report()["reason"]) == (False, "relay is external: its end is not known here")


def test_ctrl_c_says_where_a_source_elsewhere_is_to_be_ended(launch: type[Launch]) -> None:
    run = launch("source=external", "source.count=0", "source.period=0.01")
    with by_hand(run) as stage:
        run.wait_until_running()
        run.ctrl_c()
        assert run.process.stdout is not None
        line = next(line for line in run.process.stdout if "Ctrl-C" in line)
        assert "source is external: end it where it runs (Ctrl-C there); Ctrl-C again here: stop now" in line
        time.sleep(1.0)
        assert (run.process.poll(), stage.poll()) == (None, None)
        stage.send_signal(signal.SIGINT)
        assert stage.wait(LONG) == 0
    assert run.finish()[0] == 0


def test_a_second_ctrl_c_stops_a_run_whose_source_is_elsewhere(launch: type[Launch]) -> None:
    run = launch("source=external")
    run.wait_until_running()
    run.ctrl_c()
    run.wait_until_it_says("source is external: end it where it runs")
    run.ctrl_c()
    assert run.finish()[0] == 128 + signal.SIGINT


@pytest.mark.parametrize("waits", ["for its readers", "for its sender"])
def test_a_second_ctrl_c_stops_a_node_that_was_started_by_hand(waits: str) -> None:
    readers = {"Keyframe": 1} if waits == "for its readers" else {}
    with graph() as g:
        left = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, readers, status_fd=None)
        until(lambda: ("waiting" if readers else "running") in left.log.read_text())
        left.popen.send_signal(signal.SIGINT)
        time.sleep(1.0)
        assert left.popen.poll() is None
        watch = Stopwatch()
        left.popen.send_signal(signal.SIGINT)
        assert left.popen.wait(LONG) == 128 + signal.SIGINT
        assert watch.within(DOWN)
        assert "stopped (SIGINT)" in left.log.read_text()


def test_a_launcher_is_the_only_one_to_stop_the_nodes_that_it_has_started() -> None:
    with graph() as g:
        left = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, {})
        left.wait_for(lambda status: status.get("state") == "running")
        for _ in range(3):
            left.popen.send_signal(signal.SIGINT)
            time.sleep(0.3)
        assert left.popen.poll() is None


def test_a_node_that_waits_for_its_readers_notices_that_its_sender_is_gone() -> None:
    with graph() as g:
        left = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, {"Keyframe": 1})
        source = g.start("source", f"{SAMPLE}.Source", {}, {"Frame": 1}, {"count": 10**6})
        source.wait_for(lambda status: status.get("out", {}).get("Frame", 0) > 0)
        watch = Stopwatch()
        source.popen.kill()
        assert left.popen.wait(LONG) == 1
        assert watch.within(DOWN)
        until(lambda: left.last.get("state") == "failed")
        assert left.last["error"] == "PeerLost: the publisher of source.Frame disappeared before the end"


def watched_source(g: Graph, patience: float) -> Process:
    """Three frames for one reader and an observer that never comes, which is waited for so long."""
    frames = {
        "type": "Frame", "address": g.address("source.Frame"), "readers": 1, "observers": ["watcher"],
        "patience": patience,
    }  # fmt: skip
    source = g.start("source", f"{SAMPLE}.Source", {}, {}, {"count": 3}, outputs=[frames])
    source.wait_for(lambda status: status.get("state") == "waiting")
    return source


def test_an_observer_that_failed_on_another_host_is_not_waited_for_without_end() -> None:
    """Nobody can tell a node there that it is gone."""
    with graph() as g:
        source = watched_source(g, 1.0)
        time.sleep(1.5)
        assert source.last["state"] == "waiting"  # those who make the map are waited for as long as they take
        left = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, {})
        assert set(g.wait().values()) == {0}
        assert left.last["in"] == {"source.Frame": 3}
        assert source.last["warnings"] == ["source.Frame begins without watcher: not there after 1 s"]


def test_who_makes_the_map_and_leaves_while_an_observer_is_waited_for_is_waited_for_again() -> None:
    with graph() as g:
        source = watched_source(g, 4.0)
        early = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, {})
        early.wait_for(lambda status: status.get("state") == "running")
        time.sleep(1.0)  # it is counted
        early.popen.kill()
        early.popen.wait()
        time.sleep(4.5)
        assert source.last["state"] == "waiting"
        left = g.start("left", f"{SAMPLE}.Left", {"Frame": "source"}, {})
        assert set(g.wait().values()) == {0}
        assert left.last["in"] == {"source.Frame": 3}
        assert source.last["warnings"] == ["source.Frame begins without watcher: not there after 4 s"]


@pytest.mark.parametrize(
    ("given", "patience"),
    [
        (("relay=external",), 30.0),
        ((), 0.0),  # its launcher tells it
        (("relay=external", "sink=external"), 0.0),  # whoever starts that one takes the time that it takes
    ],
)
def test_only_a_stage_elsewhere_waits_for_observers_by_the_clock(
    given: tuple[str, ...], patience: float, tmp_path: Path
) -> None:
    found = compose((*given, "sink.observer=true", "supervise.dead=30"), FAKE)
    outputs = spec(found, "relay", addresses(found, tmp_path), None, None)["outputs"]
    assert {output["type"]: output["patience"] for output in outputs} == {"Keyframe": patience, "Poses": patience}


def test_a_sender_of_the_newest_that_is_gone_after_its_end_is_not_lost(tmp_path: Path) -> None:
    """The end waits to be taken, while its reader waits for others."""
    address = f"ipc://{tmp_path}/s"
    publisher, reader = Publisher(address), NewestReader(address, Frame)
    try:
        until(lambda: publisher.ready(1))
        publisher.start()
        publisher.end(End())
        until(publisher.gone)
        publisher.close()
        until(lambda: watched(reader)._lost_at is not None)
        time.sleep(2 * PEER_GRACE)
        reader.check_peer()
        assert isinstance(reader.receive(LONG), End)
    finally:
        reader.close()
        publisher.close()


def watched(reader: NewestReader) -> NewestReader:
    reader.watch()
    return reader
