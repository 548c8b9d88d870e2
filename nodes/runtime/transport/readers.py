"""The receiving ends of a topic: every message in order, or the newest only."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from msgs import End, Message
from msgs.codec import AGAIN, NEWEST, RELIABLE, CodecError, Decoded, decode, max_message_bytes, type_name
from nodes.runtime.addresses import Keys, PeerLost, TransportError, check_address
from nodes.runtime.transport.sockets import (
    GOODBYE,
    NAME_BYTES,
    OBSERVER,
    hung_up,
    left_open,
    open_monitor,
    open_socket,
    readable,
)

REFUSED = zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
LOST = zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | REFUSED
REPEATS = 8  # times that a reader which nothing comes to says again that it is there
FIRST_REPEAT = 1.0  # s after which it does for the first time; then after twice as long each time
PEER_GRACE = 0.5  # s between a disconnection and its report: whoever failed first should be heard first


class _Reader:
    """What both kinds of readers share: the connection, its monitor, and decoding."""

    delivery: bytes
    monitored = LOST | zmq.EVENT_CONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED  # events of the connection
    longest_pause = 0  # ms between two attempts to connect, from 50 on twice as long each time; 0: always 50

    def __init__(
        self,
        address: str,
        type: type,
        *,
        topic: str = "",
        buffer: int = 8,
        keys: Keys | None = None,
        token: str = "",  # of the publisher
        observer: str | None = None,  # the name of one that only observes: its loss does not concern the publisher
        away: float = 0.0,  # s for which a lost publisher is waited for: one that is started again begins anew
        say: Callable[[str], object] = lambda text: None,  # takes what a user should read
    ) -> None:
        check_address(address)
        self.topic = topic or address
        self.received = self.skipped = self.expected = 0
        self.ended = False
        self._type = type
        self._keys = keys
        self._buffer = max(1, buffer)
        self._frames: deque[zmq.Frame] = deque()  # taken over, not asked for yet
        self._descriptor: int | None = None  # of the connection
        self._lost_at: float | None = None
        self._away, self._say = away, say
        self._token, self._observer = token.encode(), observer
        self._met = False  # the publisher let this reader in once
        self._socket = open_socket(zmq.SUB, address, keys, max_message_bytes(type))
        self._socket.rcvhwm = self._buffer
        self._socket.reconnect_ivl, self._socket.reconnect_ivl_max = 50, self.longest_pause
        self.monitor = open_monitor(self._socket, self.monitored)
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self._close_socket()
            raise TransportError(f"{self.topic}: cannot connect to {address}: {error}") from error
        # Where strangers can knock, one's message can hide who said this: it is then said again, under the same name.
        self._said = [token.encode() + self.delivery + (os.urandom(NAME_BYTES) if token else b"")]
        self._opened = time.monotonic()
        if observer is not None:  # first: it must not pass for another reader
            self._socket.subscribe(token.encode() + OBSERVER + self.delivery + observer.encode())
        self._socket.subscribe(self._said[0])
        if token:  # what frames begin with, for this socket's own filter: to the publisher it says nothing
            self._socket.subscribe(self.delivery)

    def watch(self) -> None:
        """Takes note of a lost connection. Raises TransportError if the publisher refuses this reader's keys."""
        while readable(self.monitor):
            met = recv_monitor_message(self.monitor)
            event = met["event"]
            if event == zmq.EVENT_CONNECTED:
                self._descriptor = met["value"]
                continue
            if (refusal := self._refused_by(event)) is not None:
                raise TransportError(refusal)
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._met = True
                if self._lost_at is not None and self._away:
                    self._say(f"the publisher of {self.topic} is back after {time.monotonic() - self._lost_at:.1f} s")
                    self._lost_at = None
            elif self._lost_at is None:
                self._lost_at = time.monotonic()
                if self._away and not self.ended:
                    self._say(f"the publisher of {self.topic} was lost: it is waited for up to {self._away:g} s")

    def _refused_by(self, event: int) -> str | None:
        """What is wrong with the keys, as this event of the connection says; None: nothing.

        A publisher that let this reader in does not refuse it: one that dies in a handshake looks the same from here.
        """
        if self._met:
            return None
        if event & REFUSED and self._keys is not None:
            return f"the publisher of {self.topic} refused the keys: both ends need the same file"
        if event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            return f"the publisher of {self.topic} speaks another protocol: keys on one side only?"
        return None

    def check_peer(self) -> None:
        """Raises PeerLost if the publisher is gone without End, whatever of its messages still waits."""
        grace = max(PEER_GRACE, self._away)
        if self._lost_at is not None and not self.ended and time.monotonic() - self._lost_at > grace:
            late = f", and was not back within {self._away:g} s" if self._away else ""
            raise PeerLost(f"the publisher of {self.topic} disappeared before the end{late}")

    @property
    def sender(self) -> str:
        """The slot that sends a topic `slot.MessageType`."""
        return self.topic.rpartition(".")[0] or self.topic

    @property
    def type_name(self) -> str:
        return self._type.__name__

    @property
    def waiting(self) -> int:
        return len(self._frames)

    def _say_goodbye(self) -> None:
        """What the publisher waits for."""
        if self._observer is None and self.delivery == RELIABLE:
            self._socket.subscribe(self._token + GOODBYE)  # it has read the end, and is not lost
        for said in self._said:
            self._socket.unsubscribe(said)

    def _say_again(self) -> None:
        """In the thread that uses the socket: that this reader is there, should it not have been understood."""
        count = len(self._said)
        if not self._token or self._frames or self.received or self.ended or count > REPEATS:
            return
        if time.monotonic() - self._opened >= FIRST_REPEAT * (2**count - 1):
            self._said.append(self._said[0] + bytes([count]))
            self._socket.subscribe(self._said[-1])

    def _close_socket(self) -> None:
        if not self._socket.closed:
            self._socket.disable_monitor()
            self.monitor.close()
            self._socket.close(linger=500)  # ms for the goodbye to leave

    def _decode(self, frame: zmq.Frame) -> Decoded:
        try:
            return decode(frame.buffer, expect=(self._type, End))
        except CodecError as error:
            raise CodecError(f"{self.topic}: {error}") from error

    def _count(self, message: Message) -> None:
        if isinstance(message, End):
            self.ended = True
        else:
            self.received += 1


class ReliableReader(_Reader):
    """Every message of a topic, in order. Takes up to `buffer` messages over before they are asked for.

    joins: its process may have been started again in the midst of the stream, which it takes up where it gets it.
    """

    delivery = RELIABLE
    _head: Decoded | None = None  # the next message, looked at already

    def __init__(self, address: str, type: type, *, joins: bool = False, **options: Any) -> None:
        super().__init__(address, type, **options)
        self.begun = 0  # when the sender's process began, as its newest message says, ns since 1970
        self._joining = joins
        if joins:
            self._socket.subscribe(AGAIN)  # for this socket's own filter: to the publisher it says nothing
        left_open.add(self)

    @property
    def pollable(self) -> zmq.Socket[bytes]:
        return self._socket

    def watch(self) -> None:
        self._say_again()
        super().watch()

    def check_peer(self) -> None:
        if self._lost_at is None and not self._away and hung_up(self._descriptor):
            self._lost_at = time.monotonic()  # ZeroMQ does not notice it where messages wait that nobody takes
        super().check_peer()

    def head(self) -> Decoded | None:
        """The next message, if one has arrived; `take` gives it. Raises TransportError if one was lost."""
        while len(self._frames) < self._buffer and readable(self._socket):
            self._frames.append(self._socket.recv(copy=False))
        if self._head is None and self._frames and not self.ended:
            self._head = self._decode(self._frames.popleft())
            if self._away and self._head.begun != self.begun:
                self.begun, self.expected = self._head.begun, 0
            if self._joining:
                self._joining, self.expected = False, self._head.sequence
            if self._head.sequence != self.expected:
                raise TransportError(
                    f"{self.topic}: message {self._head.sequence} came where {self.expected} was due: some were lost"
                )
        return self._head

    def behind(self, begun: int, messages: int) -> bool:
        """Whether some of that many messages are still to come, of a sender whose process began then."""
        if self.begun != begun:
            return self.begun < begun and messages > 0
        return messages > self.expected

    def take(self) -> Message | None:
        """The next message, if one has arrived; after End nothing. Raises TransportError if one was lost."""
        head, self._head = self.head(), None
        if head is None:
            return None
        self.expected += 1
        self._count(head.message)
        if self.ended:
            self._say_goodbye()
        return head.message

    def close(self) -> None:
        self._close_socket()


class NewestReader(_Reader):
    """The newest message of a topic only; what it skipped is counted. Never slows the publisher.

    A thread takes the frames over, so that a busy owner finds a fresh one; only those it asks for are decoded.
    """

    delivery = NEWEST

    def __init__(self, address: str, type: type, *, missed_kept: int = 0, **options: Any) -> None:
        """missed_kept: of the messages that newer ones overtook, so many are there for who asks for them."""
        super().__init__(address, type, buffer=2, **options)
        self._frames = deque(maxlen=1)  # a newer one takes the older one's place
        self._overtaken: deque[zmq.Frame] = deque(maxlen=missed_kept)  # since the last one was taken
        self._missed: list[zmq.Frame] = []  # before it
        self._changing = threading.Lock()  # the newest, and those that it overtook
        self._odd: deque[zmq.Frame] = deque(maxlen=1)  # what took no message's place, to be reported
        self.displaced = 0  # messages that a newer one replaced before they were taken
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
        left_open.add(self)

    def take(self) -> Message | None:
        """The newest message that was not taken yet, or None. Raises CodecError for a frame that is no message."""
        while self.pollable.poll(0):
            self.pollable.recv()
        frame: zmq.Frame | None
        with self._changing:
            if self._frames:
                frame = self._frames.popleft()
                self._missed = list(self._overtaken)
                self._overtaken.clear()
            else:
                frame, self._end = self._end, None
        if frame is None and self._odd:
            frame = self._odd.popleft()
        if frame is None or self.ended:
            return None
        message, sequence, *_ = self._decode(frame)
        self._count(message)
        self._note(sequence)
        return message

    def missed(self) -> list[Message]:
        """What the message that was taken last overtook, oldest first; nothing when asked again. It counts as read."""
        frames, self._missed, found = self._missed, [], []
        for frame in frames:
            with suppress(CodecError):  # what is no message was overtaken as well
                found.append(self._decode(frame).message)
        self.received += len(found)
        self.skipped -= len(found)
        return found

    def receive(self, timeout_s: float | None = None) -> Message | None:
        """Waits for a message that was not taken yet: the newest, or End; None when none comes in time.

        Raises CodecError for a frame that is no message; the next call goes on. Raises TransportError for wrong keys.
        """
        self.watch()
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        message = self.take()
        # woken, there may be nothing: what it was for was taken before the thread said so
        while message is None and self.pollable.poll(_milliseconds_until(deadline)):
            message = self.take()
            if self.ended:
                break
        return message

    def check_peer(self) -> None:
        if self._end is None:  # else it is gone after that, which was not asked for yet
            super().check_peer()

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.pollable.close()
        self._close_socket()

    def _note(self, sequence: int) -> None:
        """A message of that number was taken."""
        self.skipped += max(0, sequence - self.expected)
        self.expected = sequence + 1

    def _attend(self) -> None:
        """Called by the thread that reads, several times a second."""

    def _accepts(self, frame: zmq.Frame) -> bool:
        """Whether a frame may take the place of the one before it."""
        return True

    def _drain(self) -> None:
        while not self._closing:
            self._attend()
            self._say_again()
            try:
                frame = self._socket.recv(copy=False)
            except zmq.Again:
                continue
            if _is_end(frame):
                self._end = frame
                self._say_goodbye()
            elif not self._accepts(frame):
                self._odd.append(frame)
            else:
                with self._changing:
                    self.displaced += len(self._frames)
                    self._overtaken.extend(self._frames)
                    self._frames.append(frame)
            self._tell()
        self._wake.close()

    def _tell(self) -> None:
        """In the thread that reads: who waits in `receive` looks again."""
        if self._wake.poll(0, zmq.POLLOUT):
            self._wake.send(b"")


def _milliseconds_until(deadline: float | None) -> int | None:
    """As `poll` takes it, of the monotonic clock; None: for ever."""
    return None if deadline is None else max(0, round(1000 * (deadline - time.monotonic())))


def _is_end(frame: zmq.Frame) -> bool:
    """Only what decodes as End ends a topic. What only says so is reported to the owner, as any frame that is none."""
    try:
        return type_name(frame.buffer) == "End" and isinstance(decode(frame.buffer, expect=(End,)).message, End)
    except CodecError:
        return False
