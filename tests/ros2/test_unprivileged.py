"""DDS is kept to its device for an ordinary user, who may bind a socket to it once."""

from __future__ import annotations

import os
import socket

import pytest

pytest.importorskip("cyclonedds")

from nodes.ros2.dds import _bind

NOBODY = 65534


def test_a_socket_that_is_bound_already_needs_no_privilege() -> None:
    """Participants of one process share Cyclone's sockets, which each of them confines."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                if os.geteuid() == 0:
                    os.setuid(NOBODY)
                for _ in range(2):
                    _bind(own.fileno(), "lo")
                code = 0
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
