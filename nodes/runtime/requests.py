"""What is asked of a source from outside: it goes out in its place among the frames, and a pause is the source's own.

Inline a source is asked in the same way, see launch/inline.py.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

from msgs import Asked, Frame, Message, Request
from nodes import Node
from nodes.runtime.addresses import TransportError
from nodes.runtime.inbox import Inbox

PAUSED = "frames while paused"


class Pause:
    """Whether a source's frames are taken.

    A recording waits until it goes on; a camera does not: its frames are left out, and counted.
    """

    def __init__(self, node: Node) -> None:
        self.on = False
        self._node = node

    @property
    def waits(self) -> bool:
        """Nothing is to be taken from the source now."""
        return self.on and not (self._node.live or getattr(self._node.config, "realtime", False))

    def leaves_out(self, message: Message) -> bool:
        if self.on and isinstance(message, Frame):
            self._node.stats.count(PAUSED)
        return self.on

    def note(self, request: Request) -> None:
        if request.asked == Asked.PAUSE and not request.problem:
            self.on = request.on
            logging.info("paused" if self.on else "goes on")


class Requests:
    """From a slot that only watches: where it is gone, nothing more is asked and the stream goes on."""

    def __init__(self, readers: list[Any], node: Node) -> None:
        self.pause = Pause(node)
        self._inbox = Inbox(readers, [])
        self._readers, self._node = readers, node

    def new(self) -> Iterator[Request]:
        """Those that came since, as they are to be sent on."""
        try:
            while self._readers and (received := self._inbox.receive(0.0)) is not None:
                if isinstance(received[1], Request):
                    self.pause.note(received[1])
                    yield received[1]
        except TransportError as error:
            self._readers = []
            if self.pause.on:
                self.pause.on = False
                self._node.stats.warn(f"the stream goes on, for who paused it is gone: {error}")


__all__ = ["PAUSED", "Pause", "Requests"]
