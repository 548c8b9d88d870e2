"""A run whose printing is lost, as its reader has ended or a disk is full: it goes on, says so and makes its report."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from launch.screen import make_screen
from tests.support.launches import FAKE, ROOT, Launch, launch
from tests.support.patience import LONG

__all__ = ["launch"]  # the fixture

COUNTED = ("source.count=150", "source.period=0.01")


@pytest.mark.slow
@pytest.mark.parametrize("screen", ["plain", "live"])
def test_a_run_whose_reader_has_ended_goes_on_and_takes_a_ctrl_c_as_ever(launch: type[Launch], screen: str) -> None:
    run = launch("source.count=0", "source.period=0.01", f"screen={screen}")
    run.wait_until_running()
    assert run.process.stdout is not None
    run.process.stdout.close()  # as `tee` does, which the same Ctrl-C ends
    run.ctrl_c()
    code, _, err = run.finish()
    assert code == 0, err
    assert "nothing more can be shown (Broken pipe)" in err
    assert "Traceback" not in err
    assert (run.output / "sink.json").exists()
    assert run.report()["map"] == "finished"


@pytest.mark.slow
@pytest.mark.parametrize("screen", ["plain", "live"])
def test_a_run_that_prints_to_a_full_disk_goes_on(tmp_path: Path, screen: str) -> None:
    command = [sys.executable, ROOT / "launch/run_all.py", "--config-path", FAKE, f"output={tmp_path / 'out'}"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*command, *COUNTED, f"screen={screen}"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=LONG,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("nothing more can be shown (No space left on device)") == 1
    assert "Traceback" not in done.stderr
    assert (tmp_path / "out" / "sink.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_run_whose_streams_were_closed_before_it_began_goes_on(tmp_path: Path, closed: str) -> None:
    words = [sys.executable, str(ROOT / "launch/run_all.py"), "--config-path", str(FAKE), f"output={tmp_path / 'out'}"]
    command = f"{shlex.join([*words, *COUNTED])} {closed}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=LONG)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "out" / "sink.json").exists()


def test_a_command_whose_output_was_closed_has_no_traceback() -> None:
    words = [sys.executable, "-c", "from mvsgs.command import main; main(['graph'])"]
    command = f"{shlex.join(words)} >&-"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=LONG, cwd=ROOT)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_help_that_cannot_be_written_fails_without_a_traceback() -> None:
    command = [sys.executable, ROOT / "launch/run_all.py", "--config-path", FAKE, "--help"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=LONG)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


def test_notes_after_a_reader_has_ended_are_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = os.pipe()
    with os.fdopen(ends[1], "w") as standard_output:
        monkeypatch.setattr(sys, "stdout", standard_output)
        screen = make_screen("off")
        screen.note("heard")
        assert os.read(ends[0], 100) == b"heard\n"
        os.close(ends[0])
        screen.note("lost")
        screen.note("lost as well")
