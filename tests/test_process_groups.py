"""Nothing that a node has started outlives it, and no signal goes to a number that may be another's by then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from launch.children import Child
from launch.status import NodeStatus
from tests.support.launches import lives
from tests.support.patience import until

pytestmark = pytest.mark.slow


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Child]:
    """A node that ends soon: what it is told is no specification."""
    started = Child(NodeStatus("a"), tmp_path / "none.json", os.pipe(), tmp_path / "a.log", {})
    yield started
    started.process.kill()
    started.process.wait()
    started.close()


def test_the_group_of_an_ended_node_is_killed_once_while_its_number_is_its_own(
    child: Child, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[int, int, str]] = []

    def note(group: int, number: int) -> None:
        told.append((group, number, psutil.Process(group).status()))

    monkeypatch.setattr(os, "killpg", note)
    until(lambda: not child.running)
    assert child.code == 2
    child.kill_group()
    child.wait()
    child.send(signal.SIGTERM)
    assert told == [(child.process.pid, signal.SIGKILL, psutil.STATUS_ZOMBIE)]


def test_what_a_node_has_started_goes_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the node itself ends well."""
    sleeper = "import subprocess; print(subprocess.Popen(['sleep', '1000']).pid, flush=True)"
    popen = subprocess.Popen

    def instead(command: list[str], **options: object) -> subprocess.Popen[bytes]:
        return popen([sys.executable, "-c", sleeper], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "Popen", instead)
    child = Child(NodeStatus("a"), tmp_path / "none.json", os.pipe(), tmp_path / "a.log", {})
    until(lambda: (tmp_path / "a.log").read_text().endswith("\n"))
    started = psutil.Process(int((tmp_path / "a.log").read_text()))  # it goes once its node's end was asked for
    child.wait()
    assert child.code == 0
    until(lambda: not lives(started))
    child.close()
