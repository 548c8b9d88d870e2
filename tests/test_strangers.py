"""Who connects to a topic over tcp without the graph's token gets nothing, holds nobody up and ends nothing."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq

from launch.ports import RANDOM
from msgs import End, Frame
from nodes.runtime.transport import NewestReader, Publisher, ReliableReader
from nodes.runtime.transport.sockets import readable
from tests.support.launches import Launch
from tests.support.patience import Stopwatch, until

pytestmark = pytest.mark.slow

TOKEN = "0123456789abcdef"
GUESSES = [b"", b"R", b"N", b"O", b"ORevaluator", b"0", b"f" * 16 + b"R", b"0123456789abcdeR"]


def free_port(topics: int = 8) -> int:
    """The first of so many free ports in a row; below those that the system gives to whoever connects meanwhile."""
    while True:
        first = RANDOM.randrange(20000, 32768 - topics)
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


def hear(publisher: Publisher) -> None:
    """Time for what was said to arrive at its socket, none of which it reads."""
    for _ in range(20):
        readable(publisher.socket)
        time.sleep(0.01)


def reader_of(address: str, opened: ExitStack) -> ReliableReader:
    return opened.enter_context(closing(ReliableReader(address, Frame, token=TOKEN)))


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
        until(lambda: (newest.take(), publisher.gone())[1], 10.0)
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


def test_a_strangers_message_neither_hides_a_reader_nor_serves_the_stranger() -> None:
    """ZeroMQ takes the next ones who speak for the sender of what it reads then."""
    address = f"tcp://127.0.0.1:{free_port(1)}"
    with (
        zmq.Context() as context,
        context.socket(zmq.XSUB) as stranger,
        closing(Publisher(address, token=TOKEN)) as publisher,
        ExitStack() as opened,
    ):
        stranger.linger = 0
        stranger.connect(address)
        for _ in range(3):
            stranger.send(b"a message")
        until(lambda: readable(publisher.socket))
        readers = [reader_of(address, opened)]
        hear(publisher)
        stranger.send(b"\x01a topic")
        hear(publisher)
        readers.append(reader_of(address, opened))
        hear(publisher)
        until(lambda: ([reader.watch() for reader in readers], publisher.ready(2))[1])
        publisher.start()
        publisher.send(Frame(3, 0.1, np.zeros((4, 6, 3), np.uint8), np.ones(4)))
        until(lambda: readers[0].take() is not None)
        until(lambda: readers[1].take() is not None)
        assert stranger.poll(200) == 0
        publisher.end(End())
        until(lambda: isinstance(readers[0].take(), End))
        until(lambda: isinstance(readers[1].take(), End))
        until(publisher.gone)


def test_a_reader_that_says_so_again_is_one_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.runtime.transport.readers.FIRST_REPEAT", 0.0)
    address = f"tcp://127.0.0.1:{free_port(1)}"
    with closing(Publisher(address, token=TOKEN)) as publisher, ExitStack() as opened:
        readers = [reader_of(address, opened) for _ in range(2)]
        until(lambda: ([reader.watch() for reader in readers], len(readers[0]._said) == 3)[1])
        until(lambda: publisher.ready(2))
        hear(publisher)
        publisher.watch()
        assert publisher.readers.total() == 2
        publisher.start()
        publisher.end(End())
        until(lambda: isinstance(readers[0].take(), End))
        until(lambda: isinstance(readers[1].take(), End))
        until(publisher.gone)
