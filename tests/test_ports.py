"""Ports for nodes that listen later."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from launch import ports
from launch.ports import free_ports


def test_ports_differ_can_be_bound_and_are_none_that_one_who_connects_gets() -> None:
    found = free_ports(100)
    assert len(set(found)) == 100
    for port in found:
        socket.create_server(("127.0.0.1", port)).close()
    if ports.RANGE.exists():
        first, last = map(int, ports.RANGE.read_text().split())
        assert not [port for port in found if first <= port <= last]


@pytest.mark.parametrize("beyond", [1024, ports.LOWEST + ports.FEW - 1])
def test_where_all_ports_are_given_to_who_connects_they_are_free_ones(
    beyond: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "RANGE", tmp_path / "range")
    ports.RANGE.write_text(f"{beyond}\t65000\n")
    for port in free_ports(3):
        socket.create_server(("127.0.0.1", port)).close()


def test_without_linux_they_are_below_those_of_iana(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "RANGE", tmp_path / "none")
    assert max(free_ports(50)) < 49152
