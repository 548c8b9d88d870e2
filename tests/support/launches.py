"""The launcher as a user runs it, for tests: a real process, in a temporary directory of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.patience import LONG, Stopwatch

ROOT = Path(__file__).resolve().parents[2]
FAKE = ROOT / "tests" / "support" / "fake_graph" / "conf"
DOWN = 5.0  # seconds in which the nodes of a graph must be gone


def lives(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def gone(processes: Sequence[psutil.Process], seconds: float) -> bool:
    """Whether all of them are in that time from now: nothing else is waited for."""
    watch = Stopwatch()
    while any(map(lives, processes)):
        if not watch.within(seconds):
            return False
        time.sleep(0.01)
    return True


class Launch:
    """One run of the launcher, in a temporary directory of its own so that whatever it leaves there is found."""

    def __init__(
        self,
        folder: Path,
        *overrides: str,
        conf: Path = FAKE,
        sockets: Path | None = None,
        prefix: Sequence[str] = (),
    ) -> None:
        """prefix: what the command is preceded by, such as a host that it runs on."""
        self.output = folder / "out"
        self._nodes: list[psutil.Process] = []  # as of when the graph was up
        self.sockets = sockets or Path(tempfile.mkdtemp(prefix="t", dir="/tmp"))  # short: a socket's path must fit
        self.process = subprocess.Popen(
            [
                *prefix,
                sys.executable,
                ROOT / "launch/run_all.py",
                "--config-path",
                conf,
                f"output={self.output}",
                *overrides,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            start_new_session=True,
            env={**os.environ, "TMPDIR": str(self.sockets), "PYTHONPATH": ""},
        )

    def finish(self, seconds: float = LONG) -> tuple[int, str, str]:
        """Exit code and what was printed; then no process, socket or temporary file of the run may be left."""
        out, err = self.process.communicate(timeout=seconds)
        assert self.nodes() == []
        assert list(self.sockets.iterdir()) == []
        self.sockets.rmdir()
        return self.process.returncode, out, err

    def nodes(self) -> list[int]:
        """Processes of this run's nodes: their spec lies in its temporary directory."""
        found = []
        for process in psutil.process_iter(["cmdline", "status"]):
            line = " ".join(process.info["cmdline"] or [])
            if f"{self.sockets}/" in line and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        return found

    def report(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.output / "report.json").read_text())
        return content

    def node(self, name: str) -> psutil.Process:
        return next(p for p in map(psutil.Process, self.nodes()) if f"/{name}.json" in " ".join(p.cmdline()))

    def log(self, node: str) -> str:
        """What that node wrote so far."""
        file = self.output / "logs" / f"{node}.log"
        return file.read_text() if file.exists() else ""

    def wait_until_running(self) -> None:
        """Until the sink's log says so, and every node's that it is past its start: they come up in any order."""
        limit = time.monotonic() + LONG
        logs = self.output / "logs"
        while True:
            over = (
                self.process.poll() is not None or time.monotonic() > limit
            )  # asked first: it may be up and have ended
            self._nodes = [] if over else psutil.Process(self.process.pid).children()
            said = {log.stem: log.read_text() for log in logs.glob("*.log")}
            if "running" in said.get("sink", "") and all("waiting" in text for text in said.values()):
                return
            assert not over, f"the graph did not come up: {self.process.communicate(timeout=10)}"
            time.sleep(0.05)

    def living(self) -> list[psutil.Process]:
        """Of the nodes that were there when the graph was up."""
        return [node for node in self._nodes if lives(node)]

    def goes_down(self, seconds: float = DOWN) -> bool:
        """Whether all nodes are gone in that time from now. What the launcher then says takes as long as it takes."""
        return gone(self._nodes, seconds)

    def ctrl_c(self) -> None:
        """As a terminal does it: to all processes of the foreground group."""
        os.killpg(self.process.pid, signal.SIGINT)

    def wait_until_it_says(self, text: str) -> None:
        """A second signal before the first one was taken would be one with it."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if text in line:
                return
        raise AssertionError(f"never said: {text}")

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[type[Launch]]:
    runs: list[Launch] = []

    class Started(Launch):
        def __init__(self, *overrides: str, conf: Path = FAKE, sockets: Path | None = None) -> None:
            super().__init__(tmp_path, *overrides, conf=conf, sockets=sockets)
            runs.append(self)

    yield Started
    for run in runs:
        run.kill()
