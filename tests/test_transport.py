"""Topics between sockets of one process: order, loss, keys, addresses, and peers that disappear."""

from __future__ import annotations

import resource
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zmq

from msgs import End, Frame, Keyframe, Poses
from msgs.codec import NEWEST, CodecError, encode
from nodes.runtime.addresses import IPC_PATH_BYTES, PeerLost, TransportError, check_address, load_keys
from nodes.runtime.inbox import Inbox
from nodes.runtime.transport import NewestReader, Publisher, ReliableReader, create_keys
from tests.support.patience import LONG, until
from tests.support.ports import tcp_address


def frame(index: int, width: int = 64) -> Frame:
    return Frame(index, index / 30, np.full((48, width, 3), index % 256, np.uint8), np.ones(4))


@pytest.fixture(params=["ipc", "tcp"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/s" if request.param == "ipc" else tcp_address()


@pytest.fixture
def ipc(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/s"


@pytest.fixture
def opened() -> Iterator[Callable[..., object]]:
    """Notes what a test opens, and closes it."""
    ends: list[Publisher | ReliableReader | NewestReader] = []

    def note(end: Publisher | ReliableReader | NewestReader) -> object:
        ends.append(end)
        return end

    yield note
    for end in reversed(ends):  # a publisher waits for its readers
        end.close()


def take_all(reader: ReliableReader, pause: float = 0.0) -> list[int]:
    inbox = Inbox([reader], [])
    indices = []
    while not reader.ended:
        received = inbox.receive(0.2)
        if received is not None and isinstance(received[1], Frame):
            assert (received[1].image == received[1].index % 256).all()
            indices.append(received[1].index)
            time.sleep(pause)
    return indices


@pytest.mark.slow
def test_a_slow_reliable_reader_gets_everything_while_a_best_effort_one_skips(address: str, opened: Callable) -> None:
    publisher = opened(Publisher(address, buffer=2))
    reader = opened(ReliableReader(address, Frame, buffer=2))
    newest = opened(NewestReader(address, Frame))
    until(lambda: publisher.ready(2))
    publisher.start()
    got: list[int] = []
    thread = threading.Thread(target=lambda: got.extend(take_all(reader, 0.001)))
    thread.start()
    for index in range(299):
        publisher.send(frame(index))
    time.sleep(0.5)  # who asks for the newest alone may lose what comes while its two places are taken
    publisher.send(frame(299))
    publisher.end(End({"a": {"n": 1}}))
    thread.join()
    assert got == list(range(300))
    until(lambda: newest._end is not None)
    assert newest.receive(LONG).index == 299  # the newest, though End came after it
    assert newest.receive(LONG) == End({"a": {"n": 1}})
    assert newest.skipped == 299
    assert newest.receive(0.01) is None
    until(publisher.gone)


@pytest.mark.slow
def test_a_full_reliable_reader_holds_the_publisher_back(ipc: str, opened: Callable) -> None:
    publisher = opened(Publisher(ipc, buffer=2))
    reader = opened(ReliableReader(ipc, Frame, buffer=2))
    until(lambda: publisher.ready(1))
    sent: list[int] = []

    def send() -> None:
        for index in range(60):
            publisher.send(frame(index, width=6400))
            sent.append(index)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    time.sleep(0.5)
    assert len(sent) < 20  # two buffers of 2, and what the kernel holds
    got = []
    until(lambda: (m := reader.take()) is not None and (got.append(m.index), m.index == 59)[1])
    assert got == list(range(60))
    thread.join(LONG)
    assert not thread.is_alive()


def test_a_lost_message_is_an_error(ipc: str, opened: Callable) -> None:
    publisher = opened(Publisher(ipc))
    reader = opened(ReliableReader(ipc, Frame))
    until(lambda: publisher.ready(1))
    publisher.send(frame(0))
    publisher.sent += 1
    publisher.send(frame(2))
    until(lambda: reader.take() is not None)
    with pytest.raises(TransportError, match="message 2 came where 1 was due"):
        until(lambda: reader.take() is not None)


def test_a_foreign_frame_is_named_and_the_next_one_is_read(ipc: str, opened: Callable) -> None:
    reader = opened(NewestReader(ipc, Frame))
    with zmq.Context() as context, context.socket(zmq.XPUB) as xpub:
        xpub.bind(ipc)
        assert xpub.recv() == b"\x01" + NEWEST
        for bad in (b"Nonsense", bytes(encode(frame(0), delivery=NEWEST))[:-5]):
            xpub.send(bad)
            with pytest.raises(CodecError, match="ipc"):
                reader.receive(LONG)
        f, grid = frame(0), np.ones((2, 2), np.float32)
        keyframe = Keyframe(f.index, f.timestamp, f.image, f.intrinsics, np.eye(4), 1.0, grid, grid, 0)
        xpub.send(encode(keyframe, delivery=NEWEST))
        with pytest.raises(CodecError, match="'Keyframe' where Frame or End"):
            reader.receive(LONG)
        xpub.send(encode(frame(3), 3, delivery=NEWEST))
        assert reader.receive(LONG).index == 3


def test_a_wake_for_what_was_taken_already_ends_no_wait(
    ipc: str, opened: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The owner may find a frame before the thread that put it there says so."""
    reader = opened(NewestReader(ipc, Frame))
    with zmq.Context() as context, context.socket(zmq.XPUB) as xpub:
        xpub.bind(ipc)
        xpub.recv()
        xpub.send(encode(frame(0), delivery=NEWEST))
        until(lambda: reader.pollable.poll(0))
        assert reader._frames.popleft()
        take, looked = reader.take, []

        def late() -> Frame | None:
            looked.append(True)
            if len(looked) == 1:
                return None  # before the wake came
            if len(looked) == 2:
                found = take()
                xpub.send(encode(frame(1), 1, delivery=NEWEST))
                return found
            return take()

        monkeypatch.setattr(reader, "take", late)
        assert reader.receive(LONG).index == 1
        assert reader.receive(0.05) is None


def test_a_frame_above_the_limit_never_reaches_memory(
    ipc: str, opened: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nodes.runtime.transport.readers.max_message_bytes", lambda type: 10_000)
    reader = opened(NewestReader(ipc, Frame))
    with zmq.Context() as context, context.socket(zmq.XPUB) as xpub:
        xpub.bind(ipc)
        xpub.recv()
        xpub.send(NEWEST + bytes(20_000))
        assert reader.receive(0.3) is None
        xpub.setsockopt(zmq.LINGER, 0)


@pytest.mark.slow
def test_a_publisher_survives_whoever_knocks(opened: Callable) -> None:
    address = tcp_address()
    publisher = opened(Publisher(address, token="secret"))  # as over tcp: who knocks is no reader
    host, port = address.removeprefix("tcp://").split(":")
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x01NULL" + bytes(48)  # ZMTP 3.1 of a client
    ready = b"\x04\x19\x05READY\x0bSocket-Type" + struct.pack(">I", 3) + b"SUB"
    rng = np.random.default_rng(0)
    for words in (b"GET / HTTP/1.1\r\n\r\n", rng.bytes(4096), greeting, greeting + ready + rng.bytes(4096),
                  greeting + ready + b"\x02" + struct.pack(">Q", 2**62)):  # fmt: skip
        with socket.create_connection((host, int(port))) as knock, suppress(ConnectionError):
            knock.sendall(words)
    reader = opened(ReliableReader(address, Frame, token="secret"))
    until(lambda: (reader.watch(), publisher.ready(1))[1])
    publisher.send(frame(3))
    until(lambda: reader.take() is not None)


def test_a_reader_refuses_a_message_length_beyond_the_limit(opened: Callable) -> None:
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x01NULL" + bytes(48)
    ready = b"\x04\x1a\x05READY\x0bSocket-Type" + struct.pack(">I", 4) + b"XPUB"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with socket.create_server(("127.0.0.1", 0)) as server:
        reader = opened(NewestReader(f"tcp://127.0.0.1:{server.getsockname()[1]}", Frame))
        connection, _ = server.accept()
        with connection:
            connection.sendall(greeting + ready + b"\x02" + struct.pack(">Q", 2**40) + b"N" * 1000)
            connection.settimeout(LONG)
            with suppress(ConnectionResetError):
                while connection.recv(4096):  # ends when the reader has closed the connection
                    pass
        assert reader.receive(0.1) is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 * 1024


@pytest.mark.slow
def test_a_publisher_that_disappears_is_noticed(address: str, opened: Callable) -> None:
    publisher = opened(Publisher(address))
    reader = opened(ReliableReader(address, Frame))
    until(lambda: publisher.ready(1))
    publisher.start()
    publisher.send(frame(0))
    inbox = Inbox([reader], [])
    assert inbox.receive(LONG)[1].index == 0
    publisher.close()
    with pytest.raises(PeerLost, match="disappeared before the end"):
        until(lambda: inbox.receive(0.1) is not None)


@pytest.mark.slow
def test_a_reader_that_disappears_is_noticed_even_by_a_publisher_that_waits_for_it(
    address: str, opened: Callable
) -> None:
    publisher = opened(Publisher(address, buffer=1))
    reader = opened(ReliableReader(address, Frame, buffer=1))
    until(lambda: publisher.ready(1))
    publisher.start()
    timer = threading.Timer(0.5, reader.close)
    timer.start()
    big = frame(0, width=6400)
    with pytest.raises(PeerLost, match="left before the end"):
        until(lambda: publisher.send(big) is not None)
    timer.join()


def test_a_best_effort_reader_may_come_and_go(ipc: str, opened: Callable) -> None:
    publisher = opened(Publisher(ipc))
    publisher.start()
    publisher.send(frame(0))
    reader = NewestReader(ipc, Frame)
    until(lambda: publisher.ready(1))
    publisher.send(frame(1))
    assert reader.receive(LONG).index == 1
    assert reader.skipped == 1  # it came late
    reader.close()
    until(lambda: not publisher.ready(1))
    publisher.send(frame(2))
    publisher.end(End())
    assert publisher.gone()


def test_a_publisher_outside_a_graph_ends_its_stream_when_it_is_closed(address: str, opened: Callable) -> None:
    publisher = Publisher(address)
    reader = opened(NewestReader(address, Frame))
    until(lambda: publisher.ready(1))
    publisher.send(frame(5))
    assert reader.receive(LONG).index == 5
    thread = threading.Thread(target=publisher.close)
    thread.start()
    assert isinstance(reader.receive(LONG), End)
    thread.join()


def test_no_socket_file_is_left(tmp_path: Path) -> None:
    Publisher(f"ipc://{tmp_path}/s").close()
    assert list(tmp_path.iterdir()) == []


def test_inputs_take_turns(tmp_path: Path, opened: Callable) -> None:
    publishers = [opened(Publisher(f"ipc://{tmp_path}/{i}")) for i in range(2)]
    readers = [opened(ReliableReader(f"ipc://{tmp_path}/{i}", Frame)) for i in range(2)]
    for publisher in publishers:
        until(lambda publisher=publisher: publisher.ready(1))
        for index in range(4):
            publisher.send(frame(index))
    until(lambda: all(reader.head() is not None and reader.waiting == 3 for reader in readers))
    inbox = Inbox(readers, publishers)
    turns = [inbox.receive(LONG)[0].topic[-1] for _ in range(8)]
    assert turns == ["0", "1"] * 4


def test_topics_of_one_sender_come_in_the_order_in_which_it_sent(tmp_path: Path, opened: Callable) -> None:
    """However they arrive: all of one topic is there before the first of the other is sent off."""
    frames = opened(Publisher(f"ipc://{tmp_path}/a.Frame"))
    ends = opened(Publisher(f"ipc://{tmp_path}/a.Poses"))
    readers = [
        opened(ReliableReader(f"ipc://{tmp_path}/a.Frame", Frame, topic="a.Frame")),
        opened(ReliableReader(f"ipc://{tmp_path}/a.Poses", Poses, topic="a.Poses")),
    ]
    until(lambda: frames.ready(1) and ends.ready(1))
    inbox = Inbox(readers, [])
    sent = ["Frame", "Poses", "Frame", "Frame", "Poses"]
    before = [{"Poses": sent[:k].count("Poses")} for k, name in enumerate(sent) if name == "Frame"]
    for k, counts in enumerate(before):
        frames.send(frame(k), counts)
    assert inbox.receive(LONG)[1].index == 0
    assert inbox.receive(0.3) is None  # the second frame was sent after the first poses
    for revision, at in enumerate(k for k, name in enumerate(sent) if name == "Poses"):
        none = np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0)
        ends.send(Poses(revision, *none), {"Frame": sent[:at].count("Frame")})
    assert [type(inbox.receive(LONG)[1]).__name__ for _ in sent[1:]] == sent[1:]


def test_keys_let_in_only_those_who_have_them(tmp_path: Path, opened: Callable) -> None:
    address = tcp_address()
    keys = create_keys(tmp_path / "keys")
    assert load_keys(tmp_path / "keys") == keys
    assert (tmp_path / "keys" / "graph.key").stat().st_mode & 0o777 == 0o600
    publisher = opened(Publisher(address, keys=keys))
    reader = opened(ReliableReader(address, Frame, keys=keys))
    until(lambda: publisher.ready(1))
    publisher.send(frame(1))
    until(lambda: reader.take() is not None)
    stranger = opened(ReliableReader(address, Frame))
    with pytest.raises(TransportError, match="speaks another protocol"):
        until(lambda: stranger.watch() or False)
    # one who knows the public key, as anybody on the wire's path may, but not the secret one
    with zmq.Context() as context, context.socket(zmq.SUB) as sub:
        sub.curve_serverkey = keys.public
        sub.curve_publickey, sub.curve_secretkey = zmq.curve_keypair()
        sub.subscribe(b"")
        monitor = sub.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_SUCCEEDED)
        sub.connect(address)
        assert monitor.poll(1000 * LONG)
        event, _ = monitor.recv_multipart()
        assert struct.unpack("=hi", event)[0] == zmq.EVENT_HANDSHAKE_FAILED_AUTH
        sub.disable_monitor()
        monitor.close()
    assert publisher.readers.total() == 1


def test_keys_that_others_can_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match="mvsgs keys"):
        load_keys(tmp_path)
    create_keys(tmp_path)
    with pytest.raises(FileExistsError):
        create_keys(tmp_path)
    (tmp_path / "graph.key").chmod(0o644)
    with pytest.raises(TransportError, match="chmod 600"):
        load_keys(tmp_path)
    (tmp_path / "graph.key").chmod(0o600)
    (tmp_path / "graph.key").write_text("nothing\n")
    with pytest.raises(TransportError, match="no key pair"):
        load_keys(tmp_path)


@pytest.mark.parametrize("address", ["tcp://0.0.0.0:5555", "tcp://*:5555", "tcp://192.168.1.2:1", "tcp://host:1"])
def test_nothing_binds_beyond_loopback_without_keys(address: str, tmp_path: Path) -> None:
    with pytest.raises(TransportError, match="give CURVE keys"):
        Publisher(address)
    check_address(address, bind=True, keys=create_keys(tmp_path))
    if "*" not in address:
        check_address(address)


@pytest.mark.parametrize("address", ["", "tcp://", "tcp://localhost", "tcp://localhost:99999", "inproc://a", "ipc://"])
def test_addresses_that_are_none_are_refused(address: str) -> None:
    with pytest.raises(TransportError, match="is no address"):
        check_address(address)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://localhost:1", "tcp://[::1]:1", "ipc:///tmp/a"])
def test_loopback_needs_no_keys(address: str) -> None:
    check_address(address, bind=True)


def test_addresses_that_cannot_be_bound_say_why(tmp_path: Path, opened: Callable) -> None:
    with pytest.raises(TransportError, match=f"longer than {IPC_PATH_BYTES}"):
        Publisher("ipc:///" + "x" * 107)
    with pytest.raises(TransportError, match="cannot bind"):
        Publisher(f"ipc://{tmp_path}/missing/s")
    address = tcp_address()
    opened(Publisher(address))
    with pytest.raises(TransportError, match="in use"):
        Publisher(address)
