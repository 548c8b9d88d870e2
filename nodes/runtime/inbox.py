"""All inputs of a node, taken in turn.

A node never waits for one chosen input: in a diamond, where two paths join again, that is a deadlock as soon as the
other path is full. Only topics of one sender are kept in the order in which it sent: what a message waits for is on its
way. So a node whose reliable inputs come from one sender gets the same messages in the same order in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nodes.runtime.transport import NewestReader, Publisher, ReliableReader, wait

Reader = ReliableReader | NewestReader


class Inbox:
    """Gives the messages of several readers; watches their publishers, and the readers of this node's publishers."""

    def __init__(self, readers: Sequence[Reader], publishers: Sequence[Publisher]) -> None:
        self._readers = list(readers)  # in the order of their turns
        self._publishers = list(publishers)
        self._sockets = [socket for reader in readers for socket in (reader.pollable, reader.monitor)]
        self._sockets += [publisher.socket for publisher in publishers]
        self._siblings = {reader: _of_the_same_sender(reader, self._readers) for reader in self._readers}

    def watch(self, timeout_s: float = 0.0) -> None:
        """Waits until something arrives on any socket. Raises TransportError for a lost peer or refused keys."""
        wait(self._sockets, timeout_s)
        for peer in (*self._readers, *self._publishers):
            peer.watch()

    def check_peers(self) -> None:
        """Raises PeerLost if a publisher is gone without End. For a node that takes no messages now; `receive` hears
        what there is first."""
        for reader in self._readers:
            reader.check_peer()

    def receive(self, timeout_s: float) -> tuple[Reader, Any] | None:
        """The next message with its reader, End included; None when none comes in time.

        Raises TransportError for a lost message or peer, CodecError for a frame that is no message.
        """
        for seconds in (0.0, timeout_s) if timeout_s > 0 else (0.0,):
            self.watch(seconds)
            for reader in self._readers:
                if self._early(reader):
                    continue
                message = reader.take()
                if message is not None:
                    self._readers.remove(reader)
                    self._readers.append(reader)  # its turn comes last now
                    return reader, message
                reader.check_peer()
        return None

    def _early(self, reader: Reader) -> bool:
        """Whether messages of other topics, sent before this reader's next one, are still to come."""
        siblings = self._siblings[reader]
        head = reader.head() if siblings and isinstance(reader, ReliableReader) else None
        if head is None or not isinstance(reader, ReliableReader):
            return False
        return any(other.behind(reader.begun, head.before.get(name, 0)) for name, other in siblings.items())


def _of_the_same_sender(reader: Reader, readers: Sequence[Reader]) -> dict[str, ReliableReader]:
    """The reliable readers of the same sender's other topics, by message type."""
    if not isinstance(reader, ReliableReader):
        return {}
    return {
        other.type_name: other
        for other in readers
        if isinstance(other, ReliableReader) and other is not reader and other.sender == reader.sender
    }
