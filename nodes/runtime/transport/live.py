"""A stream between programs that are not one graph, such as a robot's frames: either end may fail, err or come back.

What ZeroMQ does not do by itself: a SUB socket whose publisher sent more than a message may have gives the connection
up for good, without a word; here it connects anew. An XPUB socket turns readers away silently; here they are counted.
"""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from msgs.codec import NEWEST, CodecError, decode
from nodes.runtime.addresses import TransportError
from nodes.runtime.transport.publisher import Publisher
from nodes.runtime.transport.readers import REFUSED, NewestReader
from nodes.runtime.transport.sockets import open_monitor, readable

RETRY = 0.3  # s without ZeroMQ's own attempt after which a lost connection is made anew
FASTEST = 1000  # frames a second: a larger jump of the sequence numbers is no loss, but a sender that counts anew
BURST = 100  # frames that may come at once
UNSENT_BYTES = 2**17  # that wait in a publisher's kernel; what is on its way, which a long link needs more of, is not
TURNED_AWAY = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | REFUSED


class LiveReader(NewestReader):
    """The newest message of a program elsewhere. Nothing but an End that is one ends it, nothing it sends breaks it.

    `skipped` counts what can have been sent in the time that passed, whatever the sender's numbers say.
    """

    monitored = NewestReader.monitored | zmq.EVENT_CONNECTED | zmq.EVENT_CONNECT_RETRIED
    longest_pause = 2000

    def __init__(self, address: str, type: type, **options: Any) -> None:
        self.refused = 0  # frames that are no message
        self.reconnected = 0  # connections that were given up because of what came, and made anew
        self.renumbered = 0  # times that the sender's sequence numbers went on elsewhere
        self._address = address
        self._refusal: str | None = None
        self._taken_at = 0.0
        self._displaced_before = 0
        self._broken_at: float | None = None
        self.breaks = 0  # times that the connection to a program that did send broke
        super().__init__(address, type, **options)

    @property
    def met(self) -> bool:
        """Whether a publisher let this reader in once, whatever it sends."""
        return self._met

    def watch(self) -> None:
        """Raises TransportError if the publisher refuses this reader's keys and nothing ever came from there."""
        if self._refusal is not None and not self.received:
            raise TransportError(self._refusal)

    def _note(self, sequence: int) -> None:
        now, displaced, gap = time.monotonic(), self.displaced, sequence - self.expected
        if self.received > 1:
            plausible = 0 <= gap <= BURST + FASTEST * (now - self._taken_at)
            self.renumbered += not plausible
            self.skipped += gap if plausible else displaced - self._displaced_before
        self._taken_at, self._displaced_before = now, displaced
        self.expected = sequence + 1

    def _accepts(self, frame: zmq.Frame) -> bool:
        """A frame that is no message takes no good one's place."""
        try:
            decode(frame.buffer, expect=(self._type,))
        except CodecError:
            self.refused += 1
            return False
        return True

    def _attend(self) -> None:
        """In the thread that reads: the socket is its own."""
        while readable(self.monitor):
            event = recv_monitor_message(self.monitor)["event"]
            self._met |= event == zmq.EVENT_HANDSHAKE_SUCCEEDED
            self._refusal = None if self._met else self._refused_by(event) or self._refusal
            if event == zmq.EVENT_DISCONNECTED and self.received and not self.ended and self._end is None:
                self.breaks += 1
                self._tell()
            if event & (zmq.EVENT_CONNECTED | zmq.EVENT_CONNECT_RETRIED | zmq.EVENT_HANDSHAKE_SUCCEEDED):
                self._broken_at = None
            else:
                self._broken_at = time.monotonic()
        if self._broken_at is not None and time.monotonic() - self._broken_at > RETRY:
            self._broken_at = None
            self.reconnected += 1
            with suppress(zmq.ZMQError):  # ZeroMQ may have forgotten it
                self._socket.disconnect(self._address)
            self._socket.connect(self._address)


class LivePublisher(Publisher):
    """A topic of the newest only, for programs elsewhere or, over tcp, a graph's; `refused` says how many readers were
    turned away.

    No reader holds it back, so that only readers of the newest are served. Over a link that is slower than the stream
    new messages are dropped while old ones wait: as few wait as can.
    """

    served = (NEWEST,)

    def __init__(self, address: str, **options: Any) -> None:
        self._attending: threading.Thread | None = None
        super().__init__(address, buffer=1, **options)
        self.refused = 0  # attempts of readers without the right keys; one tries again several times a second
        monitor = open_monitor(self.socket, TURNED_AWAY | zmq.EVENT_ACCEPTED | zmq.EVENT_MONITOR_STOPPED)
        self._attending = threading.Thread(target=self._attend, args=(monitor,), name="readers", daemon=True)
        self._attending.start()

    def _attend(self, monitor: zmq.Socket[bytes]) -> None:
        """To readers as they come, whatever the program does meanwhile: strangers must not fill its memory."""
        with monitor:
            while (met := recv_monitor_message(monitor))["event"] != zmq.EVENT_MONITOR_STOPPED:
                if met["event"] == zmq.EVENT_ACCEPTED:
                    self._let_little_wait(met["value"])
                else:
                    self.refused += 1

    def _let_little_wait(self, descriptor: int) -> None:
        """In the kernel, for the reader of that connection."""
        if self._file is not None or not hasattr(socket, "TCP_NOTSENT_LOWAT"):  # not over TCP; not Linux or macOS
            return
        with (
            suppress(OSError),  # the connection, which is ZeroMQ's, has ended
            socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM) as connection,  # of its own: to be closed
        ):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)

    def close(self, *, farewell: bool = True) -> None:
        if self._attending is not None and not self.socket.closed:
            self.socket.disable_monitor()
            self._attending.join()
        super().close(farewell=farewell)


__all__ = ["LivePublisher", "LiveReader"]
