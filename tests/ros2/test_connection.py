"""Names, domains and interfaces of ROS 2, and what is said where there is no DDS."""

from __future__ import annotations

import importlib.util

import pytest

from nodes.ros2.connection import LOOPBACK, SOCKET_BUFFER, Connection
from nodes.ros2_camera import Ros2Camera
from nodes.ros2_publisher import Ros2Publisher


def test_names_and_domains_are_those_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Connection().interface == LOOPBACK
    assert Connection(namespace="robot1").topic("image") == "/robot1/image"
    assert Connection(namespace="/robot1/").topic("image") == "/robot1/image"
    assert Connection(namespace="/robot1").topic("/image") == "/image"
    assert Connection().topic("image") == "/image"
    for name in ("", "/", "/camera//image", "/1st", "/camera/", "ä", "/a b", "/x-y"):
        with pytest.raises(ValueError, match="no name of a topic"):
            Connection().topic(name)
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert Connection().number == 42
    assert Connection(domain=7).number == 7
    for said in ("233", "x", "-1"):
        monkeypatch.setenv("ROS_DOMAIN_ID", said)
        with pytest.raises(ValueError, match=r"domain|ROS_DOMAIN_ID"):
            Connection()
    monkeypatch.setenv("ROS_DOMAIN_ID", "")
    assert Connection().number == 0
    with pytest.raises(ValueError, match="interface"):
        Connection(interface='lo"/><x')


def test_cyclone_is_told_the_interface_and_where_memory_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///my.xml")
    for interface, told in (
        (LOOPBACK, 'address="127.0.0.1"'),
        ("eth0", 'name="eth0"'),
        ("10.0.0.2", 'address="10.0.0.2"'),
    ):
        xml = Connection(interface=interface).xml
        assert f"<NetworkInterface {told}/>" in xml
        assert "my.xml" not in xml  # which could open what was not named
        assert "<MaxSampleSize>270532608 B</MaxSampleSize>" in xml
        assert f'max="{SOCKET_BUFFER}"' in xml
    auto = Connection(interface="auto").xml
    assert "Interface" not in auto  # theirs would be one more, and not one of its own
    assert "<MaxSampleSize>270532608 B</MaxSampleSize>" in auto
    assert auto.endswith(",file:///my.xml")


def test_intrinsics_of_a_camera_of_any_size_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodes.ros2_camera.check_installed", lambda: None)
    Ros2Camera.check(Ros2Camera.Config(intrinsics=[2800.0, 2800.0, 1919.5, 1079.5]))
    with pytest.raises(ValueError, match="focal lengths must be positive"):
        Ros2Camera.check(Ros2Camera.Config(intrinsics=[-1.0, 2800.0, 1919.5, 1079.5]))


def test_without_dds_the_launcher_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for node in (Ros2Camera, Ros2Publisher):
        with pytest.raises(ValueError, match="pip install cyclonedds"):
            node.check(node.Config())
