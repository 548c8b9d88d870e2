"""DDS is kept to its device for an ordinary user, who may bind a socket to it once."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.support.shared_data import ROOT

pytest.importorskip("cyclonedds")
pytestmark = pytest.mark.slow

BOUND_TWICE = """
import os, socket
from nodes.ros2.dds import _bind

NOBODY = 65534
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
    if os.geteuid() == 0:
        os.setuid(NOBODY)
    for _ in range(2):
        _bind(own.fileno(), "lo")
"""


def test_a_socket_that_is_bound_already_needs_no_privilege() -> None:
    """Participants of one process share Cyclone's sockets, which each of them confines."""
    done = subprocess.run([sys.executable, "-c", BOUND_TWICE], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
