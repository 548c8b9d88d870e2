"""Addresses of topics and the keys of a graph: what is allowed, and why not. No socket."""

from __future__ import annotations

import ipaddress
import os
import re
import shlex
import socket
import stat
from pathlib import Path
from typing import NamedTuple

IPC_PATH_BYTES = 107  # the kernel's limit of a socket's path
KEY_FILE = "graph.key"
MAX_KEY_BYTES = 1000
_HOST = re.compile(r"[^\s/]+")


class TransportError(RuntimeError):
    """A topic cannot be opened, or a message was lost."""


class PeerLost(TransportError):
    """The other end of a topic is gone before the end: it is the one that failed."""


class Keys(NamedTuple):
    """CURVE key pair of a graph, in Z85: every process has it, and nobody without it is let in."""

    public: bytes
    secret: bytes


def load_keys(folder: Path) -> Keys:
    """The keys that `nodes.runtime.transport.create_keys` wrote.

    Raises TransportError if there are none, if the file holds no key pair, or where somebody else could have made,
    changed or read them, as ssh does: another user's file, a link, a mode or a folder that lets others in.
    """
    path = folder / KEY_FILE
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise TransportError(f"no keys at {path}: make them with `mvsgs keys {shlex.quote(str(folder))}`") from None
    except OSError as error:
        what = "is a link: put the file itself there" if path.is_symlink() else f"cannot be read: {error.strerror}"
        raise TransportError(f"{path} {what}") from None
    with os.fdopen(descriptor, "rb") as file:  # what is checked is what is read: the file that is open
        _check_private(path, os.fstat(file.fileno()), folder.stat())
        lines = file.read(MAX_KEY_BYTES).split()
    if len(lines) != 2 or any(len(line) != 40 for line in lines):
        raise TransportError(f"{path} holds no key pair: two lines of 40 characters, public and secret")
    return Keys(*lines)


def _check_private(path: Path, file: os.stat_result, folder: os.stat_result) -> None:
    """Raises TransportError, saying what to do."""
    if not stat.S_ISREG(file.st_mode):
        raise TransportError(f"{path} is no file")
    for place, owner in ((path, file.st_uid), (path.parent, folder.st_uid)):
        if owner not in (os.getuid(), 0):
            raise TransportError(
                f"{place} belongs to another user (number {owner}), who could change the keys: "
                f"copy them into a folder of your own, or chown {os.getuid()} {place}"
            )
    if file.st_mode & 0o077:
        raise TransportError(f"{path} can be read by other users: chmod 600 {path}")
    if folder.st_mode & 0o022:
        raise TransportError(
            f"{path.parent} can be written by other users, who could put other keys there: chmod go-w {path.parent}"
        )


def save_keys(folder: Path, keys: Keys) -> None:
    """To a file that only its owner can read. Raises FileExistsError rather than replace keys, and OSError."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        descriptor = os.open(folder / KEY_FILE, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise FileExistsError(f"{folder / KEY_FILE} is there already: copy it, or delete it for new keys") from None
    with os.fdopen(descriptor, "wb") as file:
        file.write(keys.public + b"\n" + keys.secret + b"\n")


def check_address(address: str, *, bind: bool = False, keys: Keys | None = None) -> None:
    """Raises TransportError for what cannot be opened, and for a bind beyond loopback without keys."""
    kind, _, rest = address.partition("://")
    if kind == "ipc" and rest:
        if len(os.fsencode(rest)) > IPC_PATH_BYTES:
            raise TransportError(f"the socket path {rest} is longer than {IPC_PATH_BYTES} bytes: use a shorter folder")
        return
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not _HOST.fullmatch(host) or not (port.isdigit() and int(port) < 65536):
        raise TransportError(f"{address} is no address; use ipc:///path or tcp://host:port")
    if not bind and (host == "*" or int(port) == 0):
        raise TransportError(
            f"{address} is where a program can listen, but nothing is reached there: give the name or number of its "
            "host (127.0.0.1: this one) and its port"
        )
    if bind and keys is None and not is_loopback(host):
        raise TransportError(
            f"{address} can be reached from other machines and would accept anybody: give CURVE keys, "
            "or bind to 127.0.0.1 or an ipc:// path"
        )


def unknown_host(address: str) -> str | None:
    """The host of an address that `check_address` accepts, where nobody knows it by that name; else None."""
    kind, _, rest = address.partition("://")
    host = rest.rpartition(":")[0].rpartition(";")[2].strip("[]")  # before a ";" is the own end of the connection
    if kind != "tcp":
        return None
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError):
        return host
    return None


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"
