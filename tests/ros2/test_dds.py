"""DDS: every type there and back with a program that has Cyclone's serializer; on an interface nothing else gets in."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from nodes.ros2.connection import DEFAULT, LATCHED, LOOPBACK, SENSOR_DATA, Connection, Quality
from nodes.ros2.messages import Header, Time
from tests.support.patience import LONG, until
from tests.support.ros2_messages import TYPES, example, plain
from tests.support.ros2_peer import OWN_DOMAIN, Peer
from tests.support.shared_data import ROOT

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow


@pytest.fixture
def participant() -> Any:
    from nodes.ros2.dds import Participant

    return Participant(Connection(domain=OWN_DOMAIN))


@pytest.mark.parametrize("message_type", TYPES, ids=lambda t: t.ros)
def test_every_type_there_and_back(peer: Peer, participant: Any, message_type: Any) -> None:
    topic = f"/there/{message_type.__name__.lower()}"
    message = example(message_type, np.random.default_rng(7))
    peer.subscribe(topic, message_type.ros)
    writer = participant.writer(topic, message_type, DEFAULT)
    until(lambda: writer.readers > 0)
    assert writer.write(message)
    assert peer.wait_for(topic) == [plain(message)]

    back = topic.replace("there", "back")
    reader = participant.reader(back, message_type, DEFAULT)
    peer.advertise(back, message_type.ros)
    peer.wait_for_reader(back)
    peer.publish(back, plain(message))
    reader.wait(LONG)
    taken = reader.take()
    assert [plain(reader.decode(data)) for data in taken] == [plain(message)]


def test_a_late_reader_gets_what_is_kept_for_it(peer: Peer, participant: Any) -> None:
    kept = participant.writer("/late/kept", Header, LATCHED)
    lost = participant.writer("/late/lost", Header, DEFAULT)
    for number in range(3):
        kept.write(Header(Time(number, 0), "map"))
        lost.write(Header(Time(number, 0), "map"))
    for topic in ("/late/kept", "/late/lost"):
        peer.subscribe(topic, Header.ros, transient_local=topic.endswith("kept"))
    assert [message["stamp"]["sec"] for message in peer.wait_for("/late/kept")] == [2]
    until(lambda: lost.readers > 0)
    lost.write(Header(Time(9, 0), "map"))
    assert [message["stamp"]["sec"] for message in peer.wait_for("/late/lost")] == [9]


@pytest.mark.parametrize(("offered", "wanted", "meet"), [(SENSOR_DATA, True, False), (DEFAULT, False, True)])
def test_qualities_meet_as_in_ros(peer: Peer, participant: Any, offered: Quality, wanted: bool, meet: bool) -> None:
    topic = f"/quality/{offered.depth}"
    writer = participant.writer(topic, Header, offered)
    peer.subscribe(topic, Header.ros, reliable=wanted)
    if meet:
        until(lambda: writer.readers > 0)
    else:
        time.sleep(1.0)
        assert writer.readers == 0


def test_an_image_of_a_megabyte_arrives_whole(peer: Peer, participant: Any) -> None:
    from nodes.ros2.messages import Image

    data = np.random.default_rng(0).integers(0, 255, 480 * 640 * 3, np.uint8)
    writer = participant.writer("/large", Image, DEFAULT)
    reader = participant.reader("/large", Image, DEFAULT)
    until(lambda: writer.readers > 0)
    writer.write(Image(Header(Time(1, 2), "camera"), 480, 640, "rgb8", 0, 1920, data))
    reader.wait(LONG)
    (taken,) = reader.take()
    assert (reader.decode(taken).data == data).all()


def bound() -> dict[int, str]:
    """Port of each UDP socket of this process that listens at all addresses -> the interface it is bound to."""
    found = {}
    for link in Path("/proc/self/fd").iterdir():
        try:
            if not str(link.readlink()).startswith("socket:"):
                continue
        except OSError:
            continue
        with socket.socket(fileno=os.dup(int(link.name))) as own:
            if own.family == socket.AF_INET and own.type == socket.SOCK_DGRAM and own.getsockname()[0] == "0.0.0.0":
                device = own.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                found[own.getsockname()[1]] = device.rstrip(b"\0").decode()
    return found


def others() -> list[tuple[str, str]]:
    """Name and address of the device by which this machine reaches others; none where it reaches nobody."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            return []
        address = asking.getsockname()[0]
    devices = psutil.net_if_addrs().items()
    return [(name, address) for name, told in devices if address in [each.address for each in told]]


def test_a_device_is_known_by_its_name_and_address(monkeypatch: pytest.MonkeyPatch) -> None:
    from nodes.ros2 import dds

    assert dds._device("auto") is None
    for loopback in (LOOPBACK, "127.0.0.1", "127.3.2.1"):
        assert dds._device(loopback) == "lo"
    assert dds._device("eth0:1") == "eth0"
    addresses = {
        "lo": ["127.0.0.1"], "no0": [], "eth3": ["02:42:0a:00:00:02", "10.0.0.2", "10.0.1.2"], "eth4:1": ["10.0.2.2"],
    }  # fmt: skip
    known = {name: [SimpleNamespace(address=each) for each in told] for name, told in addresses.items()}
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: known)
    for first_or_further in ("10.0.0.2", "10.0.1.2"):
        assert dds._device(first_or_further) == "eth3"
    assert dds._device("10.0.2.2") == "eth4"
    with pytest.raises(dds.DdsError, match=r"interface=10\.0\.0\.3.*give the device's name"):
        dds._device("10.0.0.3")


def test_a_device_that_sockets_cannot_be_bound_to_is_named() -> None:
    from nodes.ros2 import dds

    kept = pytest.raises(dds.DdsError, match=r"cannot be kept on nosuch0 .*interface=auto")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own, kept:
        dds._bind(own.fileno(), "nosuch0")


def test_nothing_listens_beyond_an_interface_unless_it_is_told_to() -> None:
    code = (
        "import sys; from nodes.ros2.connection import *; from nodes.ros2.dds import *;"
        "from nodes.ros2.messages import Header; from tests.ros2.test_dds import bound;"
        f"p = Participant(Connection(domain={OWN_DOMAIN}, interface=sys.argv[1]));"
        "r = p.reader('/x', Header, DEFAULT); w = p.writer('/x', Header, DEFAULT); print({*bound().values()})"
    )

    def devices(interface: str) -> str:
        command = [sys.executable, "-c", code, interface]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=LONG)
        return done.stdout.strip()

    for interface in (LOOPBACK, "127.0.0.1"):
        assert devices(interface) == "{'lo'}"
    assert devices("auto") == "{''}"
    for name, address in others():
        assert devices(name) == devices(address) == f"{{{name!r}}}"


def test_an_interface_that_is_none_or_another_is_refused() -> None:
    from nodes.ros2.dds import DdsError, Participant

    with pytest.raises(DdsError, match="interface=nosuch0"):
        Participant(Connection(domain=OWN_DOMAIN + 1, interface="nosuch0"))
    here = Participant(Connection(domain=OWN_DOMAIN + 2))
    with pytest.raises(DdsError, match="already"):
        Participant(Connection(domain=OWN_DOMAIN + 2, interface="auto"))
    del here
    Participant(Connection(domain=OWN_DOMAIN + 2))
