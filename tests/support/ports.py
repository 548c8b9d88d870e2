"""Where a test listens."""

from __future__ import annotations

from launch.ports import free_ports


def free_port() -> int:
    return free_ports(1)[0]


def tcp_address() -> str:
    return f"tcp://127.0.0.1:{free_port()}"
