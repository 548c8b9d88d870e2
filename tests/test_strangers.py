"""Who connects to a topic over tcp without the graph's token gets nothing, holds nobody up and ends nothing."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq

from msgs import End, Frame
from nodes.runtime.transport import NewestReader, Publisher, ReliableReader
from tests.support.launches import Launch
from tests.support.patience import Stopwatch, until

pytestmark = pytest.mark.slow

TOKEN = "0123456789abcdef"
GUESSES = [b"", b"R", b"N", b"O", b"ORevaluator", b"0", b"f" * 16 + b"R", b"0123456789abcdeR"]


def free_port(topics: int = 8) -> int:
    """The first of so many free ports in a row."""
    while True:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            first = int(probe.getsockname()[1])
        try:
            for port in range(first, first + topics):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first


@contextmanager
def strangers(ports: list[int]) -> Iterator[list[zmq.Socket[bytes]]]:
    """At each port one for each guess, who never read."""
    with zmq.Context() as context:
        sockets = []
        for port in ports:
            for guess in GUESSES:
                stranger = context.socket(zmq.SUB)
                stranger.linger = 0
                stranger.rcvhwm = 1
                stranger.connect(f"tcp://127.0.0.1:{port}")
                stranger.subscribe(guess)
                sockets.append(stranger)
        try:
            yield sockets
        finally:
            for stranger in sockets:
                stranger.close()


def test_strangers_are_no_readers_get_nothing_and_end_nothing() -> None:
    port = free_port(1)
    image = np.zeros((480, 640, 3), np.uint8)
    publisher = Publisher(f"tcp://127.0.0.1:{port}", token=TOKEN, buffer=2)
    with strangers([port]) as sockets:
        time.sleep(0.5)
        assert not publisher.ready(1)
        assert not publisher.ready(0, ["evaluator"])
        reader = ReliableReader(f"tcp://127.0.0.1:{port}", Frame, token=TOKEN, buffer=2)
        newest = NewestReader(f"tcp://127.0.0.1:{port}", Frame, token=TOKEN)
        until(lambda: publisher.ready(2))
        publisher.start()
        taken: list[int] = []

        def take() -> None:
            while not reader.ended:
                message = reader.take()
                if isinstance(message, Frame):
                    taken.append(message.index)
                elif message is None:
                    time.sleep(0.001)

        thread = threading.Thread(target=take)
        thread.start()
        for i in range(100):
            publisher.send(Frame(i, i / 10, image, np.ones(4)))
            if i == 50:
                for stranger in sockets[::2]:
                    stranger.close()  # nobody is missed
        publisher.end(End())
        until(lambda: (newest.take(), publisher.gone())[1])
        thread.join()
        newest.close()
        reader.close()
        assert taken == list(range(100))
        assert not any(stranger.poll(100) for stranger in sockets[1::2])
    publisher.close()


def test_a_reader_with_another_token_waits_in_vain() -> None:
    port = free_port(1)
    publisher = Publisher(f"tcp://127.0.0.1:{port}", token=TOKEN)
    reader = ReliableReader(f"tcp://127.0.0.1:{port}", Frame, token="f" * 16)
    time.sleep(0.5)
    assert not publisher.ready(1)
    publisher.start()
    publisher.send(Frame(0, 0.0, np.zeros((4, 4, 3), np.uint8), np.ones(4)))
    time.sleep(0.2)
    assert reader.take() is None
    reader.close()
    publisher.close()


@pytest.mark.parametrize("observer", ["false", "true"], ids=["stage", "observer"])
@pytest.mark.parametrize("leave", [False, True], ids=["stay and never read", "leave in the middle"])
def test_a_run_over_tcp_is_not_held_up_or_ended_by_strangers(tmp_path: Path, leave: bool, observer: str) -> None:
    port = free_port()
    with strangers(list(range(port, port + 8))) as sockets:
        run = Launch(
            tmp_path,
            "transport=tcp",
            f"port={port}",
            "source.count=60",
            "source.period=0.05",
            "source.size=[240,320]",
            f"sink.observer={observer}",
        )
        if leave:
            until(lambda: "running" in run.log("source"))
            time.sleep(0.5)
            for stranger in sockets:
                stranger.close()
        watch = Stopwatch()
        code, out, err = run.finish()
        assert code == 0, out + err
        assert watch.within(40.0)
