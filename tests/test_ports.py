"""Ports for nodes that listen later, and addresses of those who no longer do."""

from __future__ import annotations

import hashlib
import random
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from launch import ports
from launch.ports import free_ports
from msgs import Frame
from nodes.runtime.transport import Publisher, ReliableReader, create_keys
from nodes.runtime.transport.live import LivePublisher, LiveReader
from tests.support.patience import until
from tests.support.ports import free_port, tcp_address
from tests.support.shared_data import ROOT


def test_ports_differ_can_be_bound_and_are_none_that_one_who_connects_gets() -> None:
    found = free_ports(100)
    assert len(set(found)) == 100
    for port in found:
        socket.create_server(("127.0.0.1", port)).close()
    if ports.RANGE.exists():
        first, last = map(int, ports.RANGE.read_text().split())
        assert not [port for port in found if first <= port <= last]


def test_programs_of_the_same_seed_get_different_ones() -> None:
    """The nodes' inline run seeds the process that it is in; two that look for ports at once would take the same."""
    state, found = random.getstate(), list[list[int]]()
    for _ in range(2):
        random.seed(0)
        found.append(free_ports(3))
    random.setstate(state)
    assert found[0] != found[1]


@pytest.mark.parametrize("beyond", [1024, ports.LOWEST + ports.FEW - 1])
def test_where_all_ports_are_given_to_who_connects_they_are_free_ones(
    beyond: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "RANGE", tmp_path / "range")
    ports.RANGE.write_text(f"{beyond}\t65000\n")
    for port in free_ports(3):
        socket.create_server(("127.0.0.1", port)).close()


def test_where_those_are_all_taken_it_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", free_port())) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(ports.RANDOM, "randrange", lambda *_: port)
        assert free_port() != port


def test_without_linux_they_are_below_those_of_iana(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "RANGE", tmp_path / "none")
    assert max(free_ports(50)) < 49152


def test_publishers_with_keys_follow_each_other_at_once(tmp_path: Path) -> None:
    keys = create_keys(tmp_path / "keys")
    for address in [tcp_address() for _ in range(50)]:
        Publisher(address, keys=keys).close(farewell=False)


@pytest.mark.parametrize("kind", [Publisher, LivePublisher])
def test_who_closes_has_freed_the_address(kind: type[Publisher]) -> None:
    """Even where ZeroMQ's thread, which closes it, has to wait for a core."""
    port, stop = free_port(), threading.Event()
    busy = [threading.Thread(target=_use_a_core, args=(stop,)) for _ in range(8)]
    for each in busy:
        each.start()
    try:
        for _ in range(60):
            publisher = kind(f"tcp://127.0.0.1:{port}")
            reader = (LiveReader if kind is LivePublisher else ReliableReader)(f"tcp://127.0.0.1:{port}", Frame)
            until(lambda: publisher.ready(1))  # noqa: B023
            publisher.close(farewell=False)
            socket.create_server(("127.0.0.1", port)).close()
            reader.close()
    finally:
        stop.set()
        for each in busy:
            each.join()


def _use_a_core(stop: threading.Event) -> None:
    while not stop.is_set():
        hashlib.sha256(bytes(10**6))  # without Python's lock


def test_a_program_that_shuts_down_with_publishers_and_readers_open_ends_in_silence() -> None:
    """Their threads use sockets: to close one under a thread that reads it aborts the process, now and then."""
    code = (
        "from msgs import Frame\n"
        "from nodes.runtime.transport import LivePublisher, LiveReader, NewestReader, ReliableReader, shut_down\n"
        "for _ in range(20):\n"
        f"    publisher = LivePublisher('{(address := tcp_address())}')\n"
        f"    readers = [kind('{address}', Frame) for kind in (LiveReader, NewestReader, ReliableReader)]\n"
        "    shut_down()\n"
        "    assert publisher.socket.closed and all(reader._socket.closed for reader in readers)\n"
        "    assert not any(thread.is_alive() for thread in (publisher._attending, readers[0]._thread))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
