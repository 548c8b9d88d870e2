"""Topics over ZeroMQ: the only package that imports it.

A topic has one publisher, one message type and one address. What ZeroMQ does not do by itself is done here:

- XPUB_NODROP makes a publisher wait for its slowest reliable reader instead of dropping; sequence numbers check that
  nothing was lost.
- A best-effort reader must never slow the publisher, which NODROP would let it do on the same socket. The first byte
  of a frame says for whom it is ("R" or "N"), readers subscribe to theirs, and the "N" copy is sent with NODROP off.
- XPUB_MANUAL reports each reader's arrival and departure and leaves it to the publisher whom it serves: a stranger who
  does not begin its subscription with the graph's token gets nothing and holds nobody up. Where one sends messages,
  which ZeroMQ then confuses with subscriptions of others, these are not acted on, and are said again under the
  reader's name. A publisher waits for its
  readers at the start and for their goodbyes after `End`, because closing earlier throws away what a stalled reader
  has not read yet (libzmq issue 4660), whatever the linger.
- A reader whose publisher disappears without `End`, and a publisher whose reader leaves before it, raise PeerLost. A
  reader that only observes says so in a second subscription (`OBSERVER`), which no frame matches: it may leave.
"""

from nodes.runtime.transport.live import LivePublisher, LiveReader
from nodes.runtime.transport.publisher import Publisher
from nodes.runtime.transport.readers import NewestReader, ReliableReader
from nodes.runtime.transport.sockets import create_keys, shut_down, wait

__all__ = [
    "LivePublisher",
    "LiveReader",
    "NewestReader",
    "Publisher",
    "ReliableReader",
    "create_keys",
    "shut_down",
    "wait",
]
