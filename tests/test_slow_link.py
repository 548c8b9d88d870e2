"""A robot whose reader, or the link to it, is slower than its frames: the newest come, and nobody holds it back. A link
that is only long costs none."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zmq

from msgs import Frame
from msgs.codec import NEWEST, RELIABLE, decode
from mvsgs_core.stats import Stats
from nodes import stream_frames
from nodes.runtime.transport import LivePublisher
from nodes.stream_frames import StreamFrames
from tests.support import long_link
from tests.support.patience import LONG, until
from tests.support.ports import tcp_address
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
