"""What the tests of ROS 2 share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.support.ros2_peer import Peer


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    """Another program, in a process of its own."""
    peer = Peer()
    yield peer
    peer.close()
