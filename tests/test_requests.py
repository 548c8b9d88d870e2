"""Requests from outside: their way round the graph, and a source that is asked."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from launch.compose import compose
from launch.graph import Graph
from launch.specs import spec
from msgs import Frame, GroundTruth, Reply, Request
from nodes.reader import Reader
from nodes.robot import Robot
from nodes.runtime.requests import PAUSED, Pause, Requests
from nodes.runtime.transport import Publisher, ReliableReader

PLAYED: dict[str, Any] = {"name": "synthetic"}


def ways(graph: Graph) -> set[tuple[str, str, str]]:
    return {(e.message.__name__, e.sender, e.reader) for e in graph.edges if e.message in (Request, Reply)}


def test_requests_go_back_to_the_source_and_with_the_stream_to_who_replies() -> None:
    graph = compose(["publisher=ros2"])
    assert ways(graph) == {
        ("Request", "publisher", "dataset"), ("Request", "dataset", "tracker"), ("Request", "tracker", "mvs"),
        ("Request", "tracker", "publisher"), ("Request", "mvs", "depth_fusion"), ("Request", "depth_fusion", "mapper"),
        ("Reply", "mapper", "publisher"),
    }  # fmt: skip
    address = {f"{e.sender}.{e.message.__name__}": "ipc:///tmp/x" for e in graph.edges}
    (asked,) = [o for o in spec(graph, "publisher", address, 1, None)["outputs"] if o["type"] == "Request"]
    assert (asked["readers"], asked["observers"]) == (0, ["dataset"]), "a source that has ended is not missed"


def test_where_nobody_asks_or_a_stage_passes_nothing_on_there_are_none() -> None:
    assert ways(compose([])) == set()
    none = [f"publisher.services.{name}=''" for name in ("pause", "save_map", "load_map", "localize", "reset")]
    assert ways(compose(["publisher=ros2", *none])) == set()
    broken = compose(["publisher=ros2", "tracker._target_=examples.my_tracker.Strided"])
    assert ways(broken) == set()
    assert "publisher offers no services: tracker sends no Request" in broken.warnings


def test_a_recording_waits_and_a_camera_does_not() -> None:
    frame = Frame(0, 0.0, np.zeros((2, 2, 3), np.uint8), np.ones(4))
    truth = GroundTruth(0, 0.0, frame.image, frame.intrinsics, None, None)
    for node, waits in (
        (Reader(Reader.Config(**PLAYED)), True),
        (Reader(Reader.Config(**PLAYED, realtime=True)), False),
        (Robot(Robot.Config()), False),
    ):
        pause = Pause(node)
        pause.note(Request(1, "pause", problem="none"))
        assert not pause.leaves_out(frame)
        pause.note(Request(1, "pause"))
        assert pause.waits == waits
        assert pause.leaves_out(frame)
        assert pause.leaves_out(truth)
        assert node.stats.counts[PAUSED] == 1
        pause.note(Request(2, "pause", on=False))
        assert not pause.waits
        assert not pause.leaves_out(frame)


def test_a_source_goes_on_when_who_paused_it_is_gone(tmp_path: Path) -> None:
    address, node = f"ipc://{tmp_path}/s", Reader(Reader.Config(**PLAYED))
    publisher = Publisher(address, topic="publisher.Request")
    reader = ReliableReader(address, Request, topic="publisher.Request", observer="dataset")
    requests = Requests([reader], node)
    deadline = time.monotonic() + 20
    while not publisher.ready(0, ["dataset"]):
        assert time.monotonic() < deadline
    publisher.start()
    publisher.send(Request(1, "pause"))
    found: list[Request] = []
    while not found:
        found += requests.new()
        assert time.monotonic() < deadline
    assert found == [Request(1, "pause")]
    assert requests.pause.on
    publisher.close(farewell=False)
    while requests.pause.on:
        assert list(requests.new()) == []
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert "the stream goes on" in " ".join(node.stats.warnings)
    reader.close()
