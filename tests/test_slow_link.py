"""A sender whose reader, or the link to it, is slower than its messages: the newest come, and nobody holds it back. A
link that is only long costs none, and what is sent last comes over any."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq

from launch.compose import compose
from launch.specs import addresses, spec
from msgs import End, Frame, SplatMap
from msgs.codec import NEWEST, RELIABLE, decode
from mvsgs_core.stats import Stats
from nodes import stream_frames
from nodes.runtime.addresses import Keys
from nodes.runtime.transport import LivePublisher, NewestReader, Publisher, create_keys, publisher
from nodes.stream_frames import StreamFrames
from tests.support import long_link
from tests.support.example_messages import example
from tests.support.patience import LONG, Stopwatch, until
from tests.support.ports import free_port, tcp_address
from tests.support.processes import graph
from tests.support.shared_data import ROOT

COUNT = 40  # frames of nearly a megabyte


def frame(number: int) -> Frame:
    return Frame(number, number / 30, np.zeros((480, 640, 3), np.uint8), np.array([500.0, 500.0, 320.0, 240.0]))


def subscribed(address: str, delivery: bytes) -> zmq.Socket[bytes]:
    """A reader that takes nothing by itself."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
    socket.linger, socket.rcvhwm, socket.rcvbuf = 0, 1, 2**16
    socket.connect(address)
    socket.subscribe(delivery)
    return socket


def test_few_old_frames_wait_for_a_reader_that_is_behind() -> None:
    publisher = LivePublisher(tcp_address())
    with subscribed(publisher.topic, NEWEST) as reader:
        until(lambda: publisher.ready(1))
        for number in range(COUNT):
            publisher.send(frame(number))
            time.sleep(0.005)
        waiting = []
        while reader.poll(1000):
            message = decode(reader.recv(), expect=(Frame,)).message
            assert isinstance(message, Frame)
            waiting.append(message.index)
    publisher.close()
    assert 1 <= len(waiting) <= 6, waiting  # two at either end, and what is on its way


@pytest.mark.slow
def test_few_old_frames_of_a_node_wait_for_a_reader_of_the_newest_that_is_behind() -> None:
    with graph(buffer=128, ports=[free_port()]) as g, subscribed(g.address("source.Frame"), NEWEST) as reader:
        frames = {"type": "Frame", "address": g.address("source.Frame"), "readers": 1, "live": True}
        source = g.start(
            "source", "tests.support.sample_nodes.Source", {}, {}, {"count": COUNT, "delay": 0.005}, outputs=[frames]
        )
        source.wait_for(lambda status: status.get("state") == "ending")
        waiting = []
        while reader.poll(1000) and not isinstance(message := decode(reader.recv()).message, End):
            assert isinstance(message, Frame)
            waiting.append(message.index)
        assert 1 <= len(waiting) <= 6, waiting


@pytest.mark.parametrize(
    ("words", "live"),
    [
        (["transport=tcp"], ["dataset.Frame", "mapper.Preview"]),
        (["transport=tcp", "recorder=mcap"], ["dataset.Frame", "mapper.Preview"]),
        (["transport=tcp", "dataset.best_effort=[]", "realtime=false"], ["mapper.Preview"]),
        ([], []),  # no link is between the processes of one host
    ],
    ids=lambda given: " ".join(given) or "none",
)
def test_images_that_only_the_newest_is_read_of_are_sent_so_over_tcp(
    words: list[str], live: list[str], tmp_path: Path
) -> None:
    """But the last map, or what the tracker does last, comes however much there was before it."""
    found = compose(["dataset=robot", "dataset.path=tcp://127.0.0.1:5555", "viewer=viser", *words])
    at = addresses(found, tmp_path)
    outputs = {
        f"{name}.{output['type']}": output["live"]
        for name in found.slots
        for output in spec(found, name, at, None, None)["outputs"]
    }
    assert sorted(topic for topic, sent in outputs.items() if sent) == live


@contextmanager
def slow_link(to: int, rate: float) -> Iterator[int]:
    """A port from which one connection goes on to the other one, `rate` bytes a second back."""
    with ExitStack() as opened:
        server = opened.enter_context(socket.create_server(("127.0.0.1", 0)))

        def carry() -> None:
            reader = opened.enter_context(server.accept()[0])
            sender = opened.enter_context(socket.socket())
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**16)
            sender.connect(("127.0.0.1", to))

            def there() -> None:
                with suppress(OSError):
                    while data := reader.recv(4096):
                        sender.sendall(data)

            threading.Thread(target=there, daemon=True).start()
            with suppress(OSError):
                while data := sender.recv(2**14):
                    reader.sendall(data)
                    time.sleep(len(data) / rate)
                reader.shutdown(socket.SHUT_RDWR)

        threading.Thread(target=carry, daemon=True).start()
        yield server.getsockname()[1]


def large_map(megabytes: int) -> SplatMap:
    count = megabytes * 2**20 // 192
    small = example(SplatMap)
    assert isinstance(small, SplatMap)
    of_splats = ("means", "log_scales", "quaternions", "opacity_logits", "betas", "anchors")
    arrays = {
        name: np.zeros((count, *getattr(small, name).shape[1:]), getattr(small, name).dtype) for name in of_splats
    }
    return replace(small, sh=np.zeros((count, 11, 3), np.float32), **arrays)


@pytest.mark.slow
@pytest.mark.parametrize("with_keys", [False, True])
def test_a_last_map_that_takes_longer_than_a_goodbye_still_arrives(
    with_keys: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publisher, "NEWEST_GOODBYE", 0.3)
    keys = create_keys(tmp_path) if with_keys else None
    port, watch = free_port(), Stopwatch()
    with slow_link(port, 10e6) as there, end_of_a_topic(port, keys) as sender:
        reader = NewestReader(f"tcp://127.0.0.1:{there}", SplatMap, keys=keys)
        with closing(reader):
            until(lambda: sender.ready(1))
            sender.start()
            sender.send(large_map(16))
            sender.end(End())
            until(sender.gone)
            sender.close(farewell=False)
            assert isinstance(reader.receive(LONG), SplatMap)
            assert isinstance(reader.receive(LONG), End)
    assert not watch.within(1.0), "the link is slow"


@contextmanager
def end_of_a_topic(port: int, keys: Keys | None = None, **options: float) -> Iterator[Publisher]:
    sender = Publisher(f"tcp://127.0.0.1:{port}", keys=keys, buffer=4, **options)
    try:
        yield sender
    finally:
        sender.close(farewell=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "dead", "seconds"), [(lambda: frame(0), LONG, 0.3), (lambda: large_map(16), 1.0, 1.0)]
)
def test_a_reader_that_hangs_is_not_waited_for_without_end(
    sent: Callable[[], Frame | SplatMap], dead: float, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publisher, "NEWEST_GOODBYE", 0.3)
    port = free_port()
    with (
        slow_link(port, 1e5) as there,
        end_of_a_topic(port, dead=dead) as sender,
        subscribed(f"tcp://127.0.0.1:{there}", NEWEST),
    ):
        until(lambda: sender.ready(1))
        sender.start()
        sender.send(sent())
        sender.end(End())
        watch = Stopwatch()
        until(sender.gone)
        assert not watch.within(seconds)
        assert watch.within(seconds + 10.0)


def over_a_long_link(folder: Path, program: str) -> subprocess.CompletedProcess[str]:
    """Python that runs long_link there."""
    if shutil.which("ip") is None:
        pytest.skip("a long link needs network namespaces: there is no ip here")
    command = [sys.executable, "-c", f"import sys; from tests.support import long_link; {program}", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LONG)
    if done.returncode == long_link.NOT_PERMITTED:
        pytest.skip(f"a long link needs network namespaces, which are not permitted here: {done.stderr}")
    return done


@pytest.mark.slow
def test_a_long_link_costs_no_frame(tmp_path: Path) -> None:
    arrived: list[int] = []
    while len(arrived) < 3 and max(arrived, default=0) < 0.8 * long_link.COUNT:  # a busy machine may be slower still
        done = over_a_long_link(tmp_path / f"{len(arrived)}", "long_link.run()")
        assert done.returncode == 0, done.stderr
        arrived.append(int(done.stdout))
    assert max(arrived) >= 0.8 * long_link.COUNT, arrived  # all but some at once: a connection begins slowly


@pytest.mark.slow
def test_what_fails_over_a_long_link_is_no_lack_of_permission(tmp_path: Path) -> None:
    done = over_a_long_link(tmp_path / "keys", "long_link.LiveReader = lambda *_, **__: open('/none'); long_link.run()")
    assert done.returncode == 1
    assert "FileNotFoundError: [Errno 2] No such file or directory: '/none'" in done.stderr


@pytest.mark.parametrize(
    ("codes", "verdict"),
    [([0, 0], 0), ([77, 77], 77), ([0, 77], 77), ([77, -11], 1), ([0, -11], 1), ([1, 77], 1)],
)
def test_only_a_lack_of_permission_and_nothing_else_skips_the_long_link(codes: list[int], verdict: int) -> None:
    assert long_link.verdict(codes) == verdict


def test_a_reader_of_every_frame_is_not_served() -> None:
    publisher = LivePublisher(tcp_address())
    with subscribed(publisher.topic, RELIABLE), subscribed(publisher.topic, NEWEST) as newest:
        until(lambda: publisher.ready(1))
        time.sleep(0.3)  # the other one is there, too
        assert not publisher.ready(2)
        publisher.send(frame(0))
        assert newest.poll(5000)
    publisher.close()


def test_the_delay_of_a_stream_is_told_and_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    stats, now = Stats(), [50.0]
    monkeypatch.setattr(stream_frames.time, "monotonic", lambda: now[0])
    stream = StreamFrames(stats, "the robot")
    for number, late in enumerate((0.1, 0.0, 0.5)):
        now[0] = 50.0 + number / 30 + late
        assert stream.accept(frame(number)) is not None
    assert stats.values["delay"] == 0.5
    assert not stats.warnings
    now[0] = 50.0 + 3 / 30 + 2.5
    assert stream.accept(frame(3)) is not None
    assert stats.values["delay"] == 2.5
    assert "slower than the stream" in stats.warnings[0]


@pytest.mark.parametrize("drift", [5e-5, -5e-5])
def test_two_clocks_that_run_apart_are_no_slow_link(monkeypatch: pytest.MonkeyPatch, drift: float) -> None:
    stats, now = Stats(), [50.0]
    monkeypatch.setattr(stream_frames.time, "monotonic", lambda: now[0])
    stream = StreamFrames(stats, "the robot")
    for seconds in range(0, 24 * 3600, 60):
        now[0] = 50.0 + seconds * (1 + drift)
        assert stream.accept(replace(frame(seconds), timestamp=float(seconds))) is not None
    assert stats.values["delay"] == 0.0
    assert not stats.warnings
    for late in range(600):  # ten minutes on a slow link
        now[0] = 50.0 + seconds * (1 + drift) + late + 4.0
        assert stream.accept(replace(frame(0), timestamp=float(seconds + late + 1))) is not None
    assert 2.6 < stats.values["delay"] < 3.0
    assert "slower than the stream" in stats.warnings[0]
