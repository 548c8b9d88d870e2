"""Addresses that look right and are not: who gives one is told which part of it is wrong, without a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import zmq

from msgs import Frame
from nodes.robot import Robot
from nodes.runtime.addresses import TransportError, check_address, unknown_host
from nodes.runtime.transport import LiveReader
from tests.support.patience import LONG
from tests.support.shared_data import ROOT


@pytest.mark.parametrize("path", ["tcp://*:5555", "tcp://127.0.0.1:0"])
def test_a_robots_address_is_none_to_listen_at(path: str) -> None:
    with pytest.raises(ValueError, match="nothing is reached there"):
        Robot.check(Robot.Config(path=path))


@pytest.mark.parametrize("address", ["tcp://a b:1", "tcp://host/path:1", "tcp:///path:1"])
def test_what_is_no_name_of_a_host_is_refused(address: str) -> None:
    with pytest.raises(TransportError, match="is no address"):
        check_address(address)


def test_a_host_that_nobody_knows_is_named() -> None:
    with pytest.raises(TimeoutError, match=r"nobody here knows a host no-such-host\.invalid"):
        list(Robot(Robot.Config(path="tcp://no-such-host.invalid:5555", timeout=0.2)).run())
    assert unknown_host("tcp://no-such-host.invalid:5555") == "no-such-host.invalid"
    for known in ("tcp://127.0.0.1:1", "tcp://[::1]:1", "tcp://127.0.0.1:0;127.0.0.1:5555", "ipc:///tmp/a"):
        assert unknown_host(known) is None


def test_what_zeromq_refuses_to_connect_to_is_said() -> None:
    with pytest.raises(TransportError, match="cannot connect to tcp://;:5555: ") as told:
        LiveReader("tcp://;:5555", Frame)
    assert isinstance(told.value.__cause__, zmq.ZMQError)


def test_an_interface_that_is_none_is_named_by_the_example_of_a_robot(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds")
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    writer.write(np.zeros((48, 64, 3), dtype=np.uint8))
    writer.release()
    command = [sys.executable, "examples/robot.py", "--video", str(video), "--ros2", "/t", "--interface", "nosuch0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LONG)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: DDS cannot use interface=nosuch0"), done.stderr
    assert "Traceback" not in done.stderr
