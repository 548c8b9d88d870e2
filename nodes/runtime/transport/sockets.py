"""Sockets as all topics open them: limits, keep-alive, CURVE keys and whom they let in."""

from __future__ import annotations

import os
import select
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol
from weakref import WeakSet

import zmq
from zmq.auth.thread import ThreadAuthenticator

from nodes.runtime.addresses import Keys, save_keys

OBSERVER = b"O"  # begins the subscription by which a reader says its delivery and its name: no frame begins so
GOODBYE = b"G"  # the subscription by which a reader says that it has read the end: no frame begins so either
FREE = 5.0  # s within which ZeroMQ has freed an address that is no longer used
NAME_BYTES = 8  # of the name that follows the delivery in a reader's subscription: which of its attempts are its own


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
            self._authenticator = _started_authenticator()
            self._authenticator.configure_curve_callback("*", self)

    def leave(self, keys: Keys) -> None:
        self._users[keys] -= 1
        if self._authenticator is not None and not +self._users:
            self._authenticator.stop()
            self._authenticator = None

    def callback(self, domain: str, key: bytes) -> bool:
        return any(key == keys.public and users > 0 for keys, users in list(self._users.items()))


def _started_authenticator() -> ThreadAuthenticator:
    """Raises ZMQError. ZeroMQ frees the address of one that was stopped in its own time, after that."""
    until = time.monotonic() + FREE
    while True:
        authenticator = ThreadAuthenticator(zmq.Context.instance())
        try:
            authenticator.start()
        except zmq.ZMQError as error:
            authenticator.stop()
            if error.errno != zmq.EADDRINUSE or time.monotonic() > until:
                raise
            time.sleep(0.001)
        else:
            return authenticator


guard = _Guard()


def open_socket(kind: int, address: str, keys: Keys | None, max_bytes: int) -> zmq.Socket[bytes]:
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


def open_monitor(socket: zmq.Socket[bytes], events: int) -> zmq.Socket[bytes]:
    """What happens to its connections, in messages, until `socket.disable_monitor`.

    It holds as many as come: ZeroMQ's thread waits, and with it every socket, where a monitor that is full is not read.
    """
    address = f"inproc://monitor-{os.urandom(8).hex()}"
    socket.monitor(address, events)
    monitor: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PAIR)
    monitor.linger = monitor.rcvhwm = 0
    monitor.connect(address)
    return monitor


def free_address(socket: zmq.Socket[bytes]) -> None:
    """Of a bound tcp socket: returns when the next one can bind there. Closing alone frees it in ZeroMQ's own time."""
    address = bytes(socket.getsockopt(zmq.LAST_ENDPOINT)).rstrip(b"\0").decode()
    if not address.startswith("tcp"):
        return  # none, as binding failed, or a file that its owner removes
    with open_monitor(socket, zmq.EVENT_CLOSED) as monitor:
        socket.unbind(address)
        monitor.poll(round(FREE * 1000))
        socket.disable_monitor()


def readable(socket: zmq.Socket[bytes]) -> bool:
    return bool(int(socket.events) & zmq.POLLIN)


def hung_up(connection: int | None) -> bool:
    """Whether the other end of a connection, named by its descriptor, is gone."""
    if connection is None or not hasattr(select, "POLLRDHUP"):
        return False
    looked = select.poll()
    looked.register(connection, select.POLLRDHUP)
    return bool(looked.poll(0))


class _Closable(Protocol):
    def close(self) -> None: ...


left_open: WeakSet[_Closable] = WeakSet()  # publishers and readers, which end their threads themselves


def shut_down() -> None:
    """Closes what is left and waits until ZeroMQ's threads have sent the last goodbyes and removed the socket files.

    A socket belongs to the thread that uses it: to close one of another thread, as destroying the context does, aborts
    the process.
    """
    for each in list(left_open):
        each.close()
    zmq.Context.instance().destroy()


def wait(sockets: Iterable[zmq.Socket[bytes]], timeout_s: float) -> None:
    """Until something arrives on one of the sockets (`pollable`, `monitor`, `Publisher.socket`) or the time is up."""
    poller = zmq.Poller()
    for socket in sockets:
        poller.register(socket, zmq.POLLIN)
    poller.poll(round(timeout_s * 1000))
