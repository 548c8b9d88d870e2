"""Scripts that are started by hand: what they cannot do is said in one line, before they wait for anybody."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples import robot
from tests.support.ports import free_port
from tests.support.shared_data import ROOT


@pytest.mark.parametrize("script", ["launch/run_all.py", "examples/robot.py", "examples/camera_loop.py"])
def test_a_python_without_the_packages_is_told_which_one_has_them(script: str) -> None:
    done = subprocess.run([sys.executable, "-S", ROOT / script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: No module named '")
    assert done.stderr.endswith(f".venv/bin/python {script}\n")
    assert done.stderr.count("\n") == 1


def robot_says(monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    """How the program on the robot ends."""
    monkeypatch.setattr(sys, "argv", ["robot.py", *words, "--address", f"tcp://127.0.0.1:{free_port()}"])
    with pytest.raises(SystemExit) as ended:
        robot.main()
    return str(ended.value.code)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--video", "nothing.mp4"], "error: nothing.mp4"),
        (["--video", "notes.mp4"], "error: OpenCV cannot open notes.mp4"),
        (["--dataset", "tun", "."], "error: no dataset 'tun'"),
        (["--dataset", "tum", "nowhere"], "error: "),
        (["--camera", "77"], "error: camera 77: /dev/video77 does not exist"),
        (["--camera", "notes.mp4"], "error: notes.mp4 is a file and no camera"),
    ],
)
def test_a_robot_without_input_waits_for_no_reader(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.mp4").write_text("no video")
    assert robot_says(monkeypatch, *words).startswith(said)
    assert "waiting for a reader" not in capsys.readouterr().out


def test_a_camera_that_fails_later_is_an_error_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(arguments: object) -> Iterator[None]:
        raise OSError("the camera is gone")
        yield

    monkeypatch.setattr(robot, "opened", failing)
    monkeypatch.setattr(robot, "wait_for_reader", lambda publisher, keys: None)
    assert robot_says(monkeypatch, "--camera", "0") == "error: the camera is gone"
    assert "0 frames sent" in capsys.readouterr().out
