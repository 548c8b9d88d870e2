"""Ports for those who listen later."""

from __future__ import annotations

import random
import socket
from contextlib import ExitStack, suppress
from pathlib import Path

LOWEST = 10000  # below are the ports that programs are known by
RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")  # of ports for those who connect; elsewhere as IANA has it
FEW = 2000  # ports below that range, with which two runs hardly ever choose the same
TRIES = 1000
RANDOM = random.SystemRandom()  # not the program's own numbers: two that begin with the same seed would meet


def free_ports(count: int) -> list[int]:
    """Different ports of 127.0.0.1 that are free at this moment.

    None is of those that the system gives to whoever connects: a node takes seconds to start, and until it listens its
    readers try to connect a thousand times, one of which would get the node's own port.
    """
    with ExitStack() as held:
        return [_bound(held.enter_context(socket.socket())) for _ in range(count)]


def _bound(probe: socket.socket) -> int:
    """The port that a socket was bound to. Raises OSError where none can be."""
    beyond = int(RANGE.read_text().split()[0]) if RANGE.exists() else 49152
    for _ in range(TRIES if beyond - LOWEST >= FEW else 0):
        with suppress(OSError):
            probe.bind(("127.0.0.1", RANDOM.randrange(LOWEST, beyond)))
            break
    else:
        probe.bind(("127.0.0.1", 0))
    return int(probe.getsockname()[1])
