"""The sending end of a topic."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import zmq

from msgs import End, Message
from msgs.codec import AGAIN, NEWEST, RELIABLE, encode
from nodes.runtime.addresses import Keys, PeerLost, TransportError, check_address
from nodes.runtime.frame_pool import FramePool
from nodes.runtime.transport.kept import Kept
from nodes.runtime.transport.sockets import (
    GOODBYE,
    NAME_BYTES,
    OBSERVER,
    free_address,
    guard,
    left_open,
    open_socket,
    readable,
)

MAX_SUBSCRIPTION_BYTES = 64 * 2**10  # of what a reader may send: one byte, and the handshake
NEWEST_GOODBYE = 3.0  # s that a best-effort reader has to take its End, once nothing waits before that
HELD_BACK_MS = 100  # between two calls of `held_back`


class Publisher:
    """Sends one topic. Until `start`, messages go to whoever listens; after it, a lost reliable reader is an error,
    unless it has said that it only observes.

    `send` holds the caller back while a reliable reader is `buffer` messages behind; meanwhile it calls `held_back`,
    which may raise. Not for use by two threads.

    With `away`, a reliable reader that is lost may be started again: what it can have lost is sent to it once more, and
    only one that stays away for longer is an error. Meanwhile `buffer` messages are kept for it, then `send` waits.
    """

    served: tuple[bytes, ...] = (RELIABLE, NEWEST)  # deliveries: a reader of another gets nothing

    def __init__(
        self,
        address: str,
        *,
        topic: str = "",
        buffer: int = 8,
        keys: Keys | None = None,
        token: str = "",  # with which a reader's subscription must begin: who has none gets nothing
        held_back: Callable[[], None] = lambda: None,
        away: float = 0.0,  # s for which a lost reader is waited for; 0: it is an error at once
        dead: float = 60.0,  # s after End for which a best-effort reader is waited for at most
        begun: int = 0,  # when this process began, ns since 1970, where it may be started again within a run; else 0
        say: Callable[[str], object] = lambda text: None,  # takes what a user should read
    ) -> None:
        check_address(address, bind=True, keys=keys)
        self.topic = topic or address
        self.sent = 0
        self._arrived: Counter[bytes] = Counter()  # attempts of readers that were served, by what they said
        self.readers: Counter[bytes] = Counter()  # that are there, by delivery: one each, however often it has said so
        self.observers: dict[str, bytes] = {}  # delivery of those readers that only observe, by name
        self._essential = 0  # reliable readers that were there at the start
        self._held_back = held_back
        self._buffer, self._away, self._dead, self._say = max(1, buffer), away, dead, say
        self._begun = begun
        self._kept = Kept(self._buffer) if away else None
        self._missing_since: float | None = None  # by time.monotonic: when a reader was lost that is not back
        self._not_sent = 0  # messages that a lost reader will get when it is back
        self._goodbyes = 0
        self._newest: deque[zmq.MessageTracker] = deque(maxlen=2)  # the last message to best-effort readers, and End
        self._started = self._ended = False
        self._pool = FramePool()
        self._keys = keys
        self._token = token.encode()
        self._file = Path(address.removeprefix("ipc://")) if address.startswith("ipc") else None
        if keys is not None:
            guard.enter(keys)
        self.socket = open_socket(zmq.XPUB, address, keys, MAX_SUBSCRIPTION_BYTES)
        self.socket.sndhwm = max(1, buffer)
        self.socket.sndtimeo = HELD_BACK_MS
        self.socket.setsockopt(zmq.XPUB_NODROP, 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        try:
            self.socket.bind(address)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"{self.topic}: cannot bind {address}: {error}") from error
        left_open.add(self)

    def ready(self, readers: int, observers: Collection[str] = ()) -> bool:
        """Whether that many readers, of either kind, are there, and these observers beside them."""
        self.watch()
        return self.readers.total() - len(self.observers) >= readers and set(observers) <= self.observers.keys()

    def start(self) -> None:
        self._started = True
        self._essential = self._reliable_readers()

    def watch(self) -> None:
        """Takes note of arrivals and departures. Raises PeerLost.

        ZeroMQ takes the next one who speaks for the sender of a stranger's message: of what is read together with one,
        nobody knows who said it. Nobody is served for that; a reader that nothing comes to says it again.
        """
        doubted = False
        while readable(self.socket):
            event = self.socket.recv()
            if event[:1] in (b"\x00", b"\x01"):
                self._note(event[:1] == b"\x01", event[1:], doubted)
            else:
                doubted = True
        if not self._started or (self._ended and not self._away):
            return
        if self._missing() <= 0:
            self._missing_since = None
        elif not self._away:
            raise PeerLost(f"a reader of {self.topic} left before the end")
        elif self._missing_since is None:
            self._missing_since, self._not_sent = time.monotonic(), 0
            self._say(f"a reader of {self.topic} was lost: it is waited for up to {self._away:g} s")
        elif time.monotonic() - self._missing_since > self._away:
            raise PeerLost(f"a reader of {self.topic} left before the end, and was not back within {self._away:g} s")

    def _missing(self) -> int:
        """Reliable readers that were there at the start, are not, and have not said goodbye."""
        return self._essential - self._reliable_readers() - self._goodbyes

    def _note(self, arrived: bool, what: bytes, doubted: bool) -> None:
        if not what.startswith(self._token):
            return  # a stranger
        what = what[len(self._token) :]
        if what[:1] == OBSERVER:
            name = what[2:].decode(errors="replace")
            if arrived:
                self.observers[name] = what[1:2]
            else:
                self.observers.pop(name, None)
        elif what == GOODBYE:
            self._goodbyes += arrived
        elif what[:1] in self.served and not (arrived and doubted):  # else it is no reader of ours, or whose?
            repeated = len(what) > 1 + NAME_BYTES and any(
                count > 0 and other[: 1 + NAME_BYTES] == what[: 1 + NAME_BYTES]
                for other, count in self._arrived.items()
            )
            if arrived and not repeated and what[:1] == RELIABLE and self._started:
                self._send_again()
            self._arrived[what] = max(0, self._arrived[what] + (1 if arrived else -1))
            self.readers = self._counted()
            self.socket.setsockopt(zmq.SUBSCRIBE if arrived else zmq.UNSUBSCRIBE, what[:1])  # of the one who just spoke

    def _counted(self) -> Counter[bytes]:
        there = [what for what, count in self._arrived.items() if count > 0]
        named = {what[: 1 + NAME_BYTES] for what in there if len(what) > 1}
        nameless = {what: self._arrived[what] for what in there if len(what) == 1}
        return Counter(what[:1] for what in named) + Counter(nameless)

    def _reliable_readers(self) -> int:
        """Without observers."""
        return self.readers[RELIABLE] - list(self.observers.values()).count(RELIABLE)

    def send(self, message: Message, before: Mapping[str, int] | None = None) -> None:
        """Raises CodecError for a message that differs from its annotations, PeerLost when a reader is gone.

        before: messages that the caller has sent by its other publishers, by type.
        """
        self.watch()
        while self._missing_since is not None and self._not_sent >= self._buffer:
            self._held_back()
            self.socket.poll(HELD_BACK_MS)
            self.watch()
        sequence = self.sent
        if self.readers[NEWEST] > 0:
            self._newest.append(self._send(message, sequence, NEWEST, before))
        if self.readers[RELIABLE] > 0:
            self._send(message, sequence, RELIABLE, before)
        elif self._kept is not None:
            self._kept.add(encode(message, sequence, before=before, begun=self._begun, delivery=RELIABLE))
        self.sent = sequence + 1  # not by a message that cannot be encoded: readers would miss it
        self._not_sent += 1

    def end(self, message: End) -> None:
        self._ended = True
        self.send(message)
        self._end, self._end_at = message, time.monotonic()
        self._deadline = self._end_at + NEWEST_GOODBYE

    def gone(self) -> bool:
        """After `end`, to be asked several times a second: whether all readers have said goodbye.

        A best-effort one is waited for while the last message is on its way to it, and for a short time after that.
        """
        self.watch()
        now = time.monotonic()
        if not all(sent.done for sent in self._newest):
            self._deadline = min(now + NEWEST_GOODBYE, self._end_at + self._dead)
        elif self.readers[NEWEST] > 0 and now <= self._deadline:
            self._newest.append(self._send(self._end, self.sent - 1, NEWEST))
        late = now > self._deadline
        there = self.readers[RELIABLE] > 0 or (self._away > 0 and self._missing() > 0)
        return not there and (late or self.readers[NEWEST] <= 0)

    def close(self, *, farewell: bool = True) -> None:
        """Frees the address. A publisher outside a graph first sends End to those who listen and waits a second for
        them; without `farewell` they notice that it is lost."""
        if self.socket.closed:
            return
        if farewell and not self._started and not self._ended:
            self.end(End())
            until = time.monotonic() + 1.0
            while not self.gone() and time.monotonic() < until:
                self.socket.poll(20)
        free_address(self.socket)
        self.socket.close(linger=0)
        if self._file is not None:
            self._file.unlink(missing_ok=True)
        if self._keys is not None:
            guard.leave(self._keys)

    def _send(
        self, message: Message, sequence: int, delivery: bytes, before: Mapping[str, int] | None = None
    ) -> zmq.MessageTracker:
        buffers: list[np.ndarray] = []

        def allocate(size: int) -> np.ndarray:
            buffers.append(self._pool.take(size))
            return buffers[0]

        frame = encode(message, sequence, before=before, begun=self._begun, delivery=delivery, allocate=allocate)
        if self._kept is not None and delivery == RELIABLE:
            self._kept.add(frame)
        tracker = self._deliver(frame, delivery != NEWEST)
        self._pool.give(buffers[0], tracker)
        return tracker

    def _deliver(self, frame: memoryview | bytes, reliably: bool) -> zmq.MessageTracker:
        self.socket.setsockopt(zmq.XPUB_NODROP, int(reliably))
        copy = False if self._ended else None  # of a copy nobody is told when it has left, and of End it matters
        whole = zmq.Frame(frame, track=True, copy=copy, copy_threshold=self.socket.copy_threshold)
        while True:
            try:
                return self.socket.send(whole, copy=False, track=True)
            except zmq.Again:
                self._held_back()

    def _send_again(self) -> None:
        """To the reader that just spoke and to nobody else, before it is sent anything new."""
        if self._kept is None:
            return
        self.socket.setsockopt(zmq.SUBSCRIBE, AGAIN)
        for frame in self._kept:
            self._deliver(frame, True)
        with suppress(zmq.ZMQError):  # it may be gone again
            self.socket.setsockopt(zmq.UNSUBSCRIBE, AGAIN)
        self._say(f"a reader of {self.topic} was started again: it was sent {len(self._kept)} messages once more")
