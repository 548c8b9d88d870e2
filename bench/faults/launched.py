"""A run started as a user starts it, with a temporary folder of its own, so that whatever it leaves is found."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import psutil

from bench.runs import ROOT, launcher
from mvsgs_core.export.ply import read_ply


class Launched:
    """One run of the launcher. To be closed."""

    def __init__(self, output: Path, arguments: Sequence[str]) -> None:
        """`output` is where the arguments make it write."""
        self.output = output
        self._temporary = Path(tempfile.mkdtemp(prefix="f", dir="/tmp"))  # short: a socket's path must fit
        self._log = (output.parent / f"{output.name}.log").open("w+")
        self.process = subprocess.Popen(
            [*launcher(), *arguments],
            stdout=self._log,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            start_new_session=True,
            env={**os.environ, "TMPDIR": str(self._temporary)},
        )

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self, seconds: float = 300.0) -> int:
        """Exit code. Raises TimeoutExpired."""
        return self.process.wait(seconds)

    def wait_for(self, reached: Callable[[], bool], seconds: float = 120.0) -> bool:
        """Whether it came so far, before it ended and before the time was over."""
        until = time.monotonic() + seconds
        while not reached():
            if not self.running or time.monotonic() > until:
                return False
            time.sleep(0.01)
        return True

    def node(self, name: str) -> psutil.Process | None:
        """The process of that slot, as long as there is one."""
        return next((p for p in self._processes() if f"/{name}.json" in " ".join(p.info["cmdline"] or [])), None)

    def send(self, name: str, number: signal.Signals) -> bool:
        """Whether there was somebody to get the signal."""
        process = self.node(name)
        try:
            if process is not None:
                process.send_signal(number)
        except psutil.NoSuchProcess:
            return False
        return process is not None

    def left(self) -> list[str]:
        """Processes of the run's nodes, and what is in its temporary folder."""
        return [str(p.pid) for p in self._processes()] + [path.name for path in self._temporary.iterdir()]

    def report(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.output / "report.json").read_text())
        return content

    def said(self) -> str:
        return Path(self._log.name).read_text()

    def close(self) -> None:
        if self.running:
            self.process.kill()  # takes its nodes along
            self.process.wait()
        self._log.close()
        shutil.rmtree(self._temporary, ignore_errors=True)

    def __enter__(self) -> Launched:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _processes(self) -> list[Any]:
        found = []
        for process in psutil.process_iter(["cmdline", "status"]):
            line = " ".join(process.info["cmdline"] or [])
            if f"{self._temporary}/" in line and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process)
        return found


def map_opens(output: Path) -> bool:
    """Whether map.ply is whole and holds splats, and trajectory.txt poses."""
    try:
        splats = len(read_ply(output / "map.ply").splats)
        lines = [line.split() for line in (output / "trajectory.txt").read_text().splitlines()]
    except (OSError, ValueError):
        return False
    poses = [[float(word) for word in line] for line in lines if line and line[0] != "#"]
    return splats > 0 and len(poses) > 0 and all(len(pose) == 8 for pose in poses)
