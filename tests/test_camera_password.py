"""The password in a camera's address is written nowhere, by no library either."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow

OPENED = """
import sys
from nodes.camera import Camera, CameraError
try:
    list(Camera(Camera.Config(path=sys.argv[1], timeout=1.0)).run())
except CameraError as error:
    print(error)
"""


@pytest.mark.parametrize("address", ["rtsp://me:p%40ss@127.0.0.1:1/s", "http://me:p%40ss@127.0.0.1:1/s.mjpg"])
def test_a_camera_that_does_not_answer_leaves_no_password_in_the_log(address: str) -> None:
    done = subprocess.run([sys.executable, "-c", OPENED, address], cwd=ROOT, capture_output=True, text=True)
    assert "cannot be opened: is the address right" in done.stdout
    assert "p%40ss" not in done.stdout + done.stderr
    assert "p@ss" not in done.stdout + done.stderr
