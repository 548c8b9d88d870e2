"""Topics over ZeroMQ: the only file that imports it.

A topic has one publisher, one message type and one address. What ZeroMQ does not do by itself is done here:

- XPUB_NODROP makes a publisher wait for its slowest reliable reader instead of dropping; sequence numbers check that
  nothing was lost.
- A best-effort reader must never slow the publisher, which NODROP would let it do on the same socket. The first byte
  of a frame says for whom it is ("R" or "N"), readers subscribe to theirs, and the "N" copy is sent with NODROP off.
- XPUB_VERBOSER reports each reader's arrival and departure: a publisher waits for its readers at the start and for
  their goodbyes after `End`, because closing earlier throws away what a stalled reader has not read yet
  (libzmq issue 4660), whatever the linger.
- A reader whose publisher disappears without `End`, and a publisher whose reader leaves before it, raise PeerLost.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import zmq
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import recv_monitor_message

from msgs import End, Message
from msgs.codec import NEWEST, RELIABLE, CodecError, Decoded, decode, encode, max_message_bytes, type_name
from nodes.addresses import Keys, PeerLost, TransportError, check_address, save_keys
from nodes.frame_pool import FramePool

MAX_SUBSCRIPTION_BYTES = 64 * 2**10  # of what a reader may send: one byte, and the handshake
REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
LOST = zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | REFUSED
PEER_GRACE = 0.5  # s between a disconnection and its report: whoever failed first should be heard first
NEWEST_GOODBYE = 3.0  # s that a best-effort reader has to take its End


def create_keys(folder: str | Path) -> Keys:
    """A new key pair in `folder`; copy it (scp -p) to each machine of the graph."""
    keys = Keys(*zmq.curve_keypair())
    save_keys(Path(folder), keys)
    return keys


class _Guard:
    """Lets in only readers that own a graph's secret key: knowing the public one is not enough."""

    def __init__(self) -> None:
        self._users: Counter[Keys] = Counter()
        self._authenticator: ThreadAuthenticator | None = None

    def enter(self, keys: Keys) -> None:
        self._users[keys] += 1
        if self._authenticator is None:
            self._authenticator = ThreadAuthenticator(zmq.Context.instance())
            self._authenticator.start()
            self._authenticator.configure_curve_callback("*", self)

    def leave(self, keys: Keys) -> None:
        self._users[keys] -= 1
        if self._authenticator is not None and not +self._users:
            self._authenticator.stop()
            self._authenticator = None

    def callback(self, domain: str, key: bytes) -> bool:
        return any(key == keys.public and users > 0 for keys, users in list(self._users.items()))


_guard = _Guard()


def _open(kind: int, address: str, keys: Keys | None, max_bytes: int) -> zmq.Socket[bytes]:
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    socket.linger = 0
    socket.maxmsgsize = max_bytes
    if address.startswith("tcp"):
        socket.ipv6 = "[" in address
        socket.tcp_keepalive, socket.tcp_keepalive_idle = 1, 10
        socket.tcp_keepalive_intvl, socket.tcp_keepalive_cnt = 5, 3
    if keys is not None:
        socket.curve_publickey, socket.curve_secretkey = keys
        if kind == zmq.XPUB:
            socket.curve_server = True
        else:
            socket.curve_serverkey = keys.public
    return socket


def _readable(socket: zmq.Socket[bytes]) -> bool:
    return bool(int(socket.events) & zmq.POLLIN)


class Publisher:
    """Sends one topic. Until `start`, messages go to whoever listens; after it, a lost reliable reader is an error.

    `send` holds the caller back while a reliable reader is `buffer` messages behind. Not for use by two threads.
    """

    def __init__(
        self,
        address: str,
        *,
        topic: str = "",
        buffer: int = 8,
        keys: Keys | None = None,
        max_bytes: int | None = None,
    ) -> None:
        check_address(address, bind=True, keys=keys)
        self.topic = topic or address
        self.sent = 0
        self.readers: Counter[bytes] = Counter()  # by delivery
        self._max_bytes = max_bytes
        self._started = self._ended = False
        self._pool = FramePool()
        self._keys = keys
        self._file = Path(address.removeprefix("ipc://")) if address.startswith("ipc") else None
        if keys is not None:
            _guard.enter(keys)
        self.socket = _open(zmq.XPUB, address, keys, MAX_SUBSCRIPTION_BYTES)
        self.socket.sndhwm = max(1, buffer)
        self.socket.setsockopt(zmq.XPUB_NODROP, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        try:
            self.socket.bind(address)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"{self.topic}: cannot bind {address}: {error}") from error

    def ready(self, readers: int) -> bool:
        """Whether that many readers, of either kind, are there."""
        self.watch()
        return self.readers.total() >= readers

    def start(self) -> None:
        self._started = True

    def watch(self) -> None:
        """Takes note of arrivals and departures. Raises PeerLost."""
        while _readable(self.socket):
            event = self.socket.recv()
            delivery = event[1:]
            if delivery not in (RELIABLE, NEWEST):
                continue  # no reader of ours
            if event[:1] == b"\x01":
                self.readers[delivery] += 1
            elif self.readers[delivery] > 0:
                self.readers[delivery] -= 1
                if delivery == RELIABLE and self._started and not self._ended:
                    raise PeerLost(f"a reader of {self.topic} left before the end")

    def send(self, message: Message) -> None:
        """Raises CodecError for a message that differs from its annotations, PeerLost when a reader is gone."""
        self.watch()
        sequence, self.sent = self.sent, self.sent + 1
        if self.readers[NEWEST] > 0:
            self._send(message, sequence, NEWEST)
        if self.readers[RELIABLE] > 0:
            self._send(message, sequence, RELIABLE)

    def end(self, message: End) -> None:
        self._ended = True
        self.send(message)
        self._end, self._deadline = message, time.monotonic() + NEWEST_GOODBYE

    def gone(self) -> bool:
        """After `end`: whether all readers have said goodbye."""
        self.watch()
        late = time.monotonic() > self._deadline
        if self.readers[NEWEST] > 0 and not late:
            self._send(self._end, self.sent - 1, NEWEST)
        return self.readers[RELIABLE] <= 0 and (late or self.readers[NEWEST] <= 0)

    def close(self) -> None:
        """Unbinds. A publisher outside a graph first sends End to those who listen and waits a second for them."""
        if self.socket.closed:
            return
        if not self._started and not self._ended:
            self.end(End())
            until = time.monotonic() + 1.0
            while not self.gone() and time.monotonic() < until:
                self.socket.poll(20)
        self.socket.close(linger=0)
        if self._file is not None:
            self._file.unlink(missing_ok=True)
        if self._keys is not None:
            _guard.leave(self._keys)

    def _send(self, message: Message, sequence: int, delivery: bytes) -> None:
        buffers: list[np.ndarray] = []

        def allocate(size: int) -> np.ndarray:
            buffers.append(self._pool.take(size))
            return buffers[0]

        frame = encode(message, sequence, delivery=delivery, max_bytes=self._max_bytes, allocate=allocate)
        self.socket.setsockopt(zmq.XPUB_NODROP, int(delivery == RELIABLE))
        tracker = self.socket.send(frame, copy=False, track=True)
        self._pool.give(buffers[0], tracker)


class _Reader:
    """What both kinds of readers share: the connection, its monitor, and decoding."""

    delivery: bytes

    def __init__(
        self,
        address: str,
        type: type,
        *,
        topic: str = "",
        buffer: int = 8,
        keys: Keys | None = None,
        max_bytes: int | None = None,
    ) -> None:
        check_address(address)
        self.topic = topic or address
        self.received = self.skipped = self.expected = 0
        self.ended = False
        self._type = type
        self._keys = keys
        self._buffer = max(1, buffer)
        self._max_bytes = max_message_bytes(type) if max_bytes is None else max_bytes
        self._frames: deque[zmq.Frame] = deque()  # taken over, not asked for yet
        self._lost_at: float | None = None
        self._socket = _open(zmq.SUB, address, keys, self._max_bytes)
        self._socket.rcvhwm = self._buffer
        self._socket.reconnect_ivl = 50
        self.monitor = self._socket.get_monitor_socket(LOST)
        self._socket.connect(address)
        self._socket.subscribe(self.delivery)

    def watch(self) -> None:
        """Takes note of a lost connection. Raises TransportError if the publisher refuses this reader's keys."""
        while _readable(self.monitor):
            event = recv_monitor_message(self.monitor)["event"]
            if event & REFUSED and self._keys is not None:
                raise TransportError(f"the publisher of {self.topic} refused the keys: both ends need the same file")
            if event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                raise TransportError(f"the publisher of {self.topic} speaks another protocol: keys on one side only?")
            if self._lost_at is None:
                self._lost_at = time.monotonic()

    def check_peer(self) -> None:
        """Raises PeerLost if the publisher is gone without End. To be called when no message waits."""
        if self._lost_at is not None and not self.ended and time.monotonic() - self._lost_at > PEER_GRACE:
            raise PeerLost(f"the publisher of {self.topic} disappeared before the end")

    @property
    def waiting(self) -> int:
        return len(self._frames)

    def _close_socket(self) -> None:
        if not self._socket.closed:
            self._socket.disable_monitor()
            self.monitor.close()
            self._socket.close(linger=500)  # ms for the goodbye to leave

    def _decode(self, frame: zmq.Frame) -> Decoded:
        try:
            decoded = decode(frame.buffer, expect=(self._type, End), max_bytes=self._max_bytes)
        except CodecError as error:
            raise CodecError(f"{self.topic}: {error}") from error
        if isinstance(decoded.message, End):
            self.ended = True
        else:
            self.received += 1
        return decoded


class ReliableReader(_Reader):
    """Every message of a topic, in order. Takes up to `buffer` messages over before they are asked for."""

    delivery = RELIABLE

    @property
    def pollable(self) -> zmq.Socket[bytes]:
        return self._socket

    def take(self) -> Message | None:
        """The next message, if one has arrived; after End nothing. Raises TransportError if one was lost."""
        while len(self._frames) < self._buffer and _readable(self._socket):
            self._frames.append(self._socket.recv(copy=False))
        if not self._frames or self.ended:
            return None
        message, sequence = self._decode(self._frames.popleft())
        if sequence != self.expected:
            raise TransportError(f"{self.topic}: message {sequence} came where {self.expected} was due: some were lost")
        self.expected += 1
        if self.ended:
            self._socket.unsubscribe(self.delivery)  # the goodbye that the publisher waits for
        return message

    def close(self) -> None:
        self._close_socket()


class NewestReader(_Reader):
    """The newest message of a topic only; what it skipped is counted. Never slows the publisher.

    A thread takes the frames over, so that a busy owner finds a fresh one; only those it asks for are decoded.
    """

    delivery = NEWEST

    def __init__(
        self,
        address: str,
        type: type,
        *,
        topic: str = "",
        late: bool = True,  # what was sent before the first message that it gets is not "skipped"
        keys: Keys | None = None,
        max_bytes: int | None = None,
    ) -> None:
        super().__init__(address, type, topic=topic, buffer=2, keys=keys, max_bytes=max_bytes)
        self._frames = deque(maxlen=1)  # a newer one takes the older one's place
        self._late = late
        self._end: zmq.Frame | None = None
        self._closing = False
        wake = f"inproc://newest-{id(self)}"
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self.pollable = context.socket(zmq.PAIR)
        self.pollable.bind(wake)
        self._wake = context.socket(zmq.PAIR)
        self._wake.connect(wake)
        self._wake.linger = 0
        self._socket.rcvtimeo = 100
        self._thread = threading.Thread(target=self._drain, name=f"newest {self.topic}", daemon=True)
        self._thread.start()

    def take(self) -> Message | None:
        """The newest message that was not taken yet, or None. Raises CodecError for a frame that is no message."""
        while self.pollable.poll(0):
            self.pollable.recv()
        frame: zmq.Frame | None
        try:
            frame = self._frames.popleft()
        except IndexError:
            frame, self._end = self._end, None
        if frame is None or self.ended:
            return None
        message, sequence = self._decode(frame)
        if not self._late or self.expected:
            self.skipped += max(0, sequence - self.expected)
        self.expected = sequence + 1
        return message

    def receive(self, timeout_s: float | None = None) -> Message | None:
        """Waits for a message that was not taken yet: the newest, or End; None when none comes in time.

        Raises CodecError for a frame that is no message; the next call goes on. Raises TransportError for wrong keys.
        """
        self.watch()
        message = self.take()
        if message is None and self.pollable.poll(None if timeout_s is None else round(timeout_s * 1000)):
            message = self.take()
        return message

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.pollable.close()
        self._close_socket()

    def _drain(self) -> None:
        while not self._closing:
            try:
                frame = self._socket.recv(copy=False)
            except zmq.Again:
                continue
            try:
                is_end = type_name(frame.buffer) == "End"
            except CodecError:
                is_end = False  # reported to the owner when it decodes the frame
            if is_end:
                self._end = frame
                self._socket.unsubscribe(self.delivery)
            else:
                self._frames.append(frame)
            if self._wake.poll(0, zmq.POLLOUT):
                self._wake.send(b"")
        self._wake.close()


def shut_down() -> None:
    """Closes what is left and waits until ZeroMQ's threads have sent the last goodbyes and removed the socket files."""
    zmq.Context.instance().destroy()


def wait(sockets: Iterable[zmq.Socket[bytes]], timeout_s: float) -> None:
    """Until something arrives on one of the sockets (`pollable`, `monitor`, `Publisher.socket`) or the time is up."""
    poller = zmq.Poller()
    for socket in sockets:
        poller.register(socket, zmq.POLLIN)
    poller.poll(round(timeout_s * 1000))
