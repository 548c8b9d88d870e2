"""Graphs of real processes for the tests: started as a launcher would, watched, and looked after when they are gone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nodes.runtime.signals import STARTING
from tests.support.patience import LONG, until
from tests.support.shared_data import ROOT

ENVIRONMENT = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@dataclass
class Process:
    """One node; its status lines are collected as they come."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path
    lines: list[dict[str, Any]] = field(default_factory=list)

    @property
    def last(self) -> dict[str, Any]:
        return self.lines[-1] if self.lines else {}

    def listen(self, fd: int) -> None:
        with os.fdopen(fd) as file:
            self.lines.extend(json.loads(line) for line in iter(file.readline, ""))

    def wait_for(self, reached: Any, seconds: float = LONG) -> None:
        """Until one of its status lines says so: a state may be over before anybody looks."""
        until(
            lambda: any(reached(line) for line in [*self.lines]),
            seconds,
            lambda: f"{self.name}: {self.last}\n{self.log.read_text()}",
        )


class Graph:
    """Processes by node name, in a short-named directory of their own."""

    def __init__(self, buffer: int = 2, ports: Sequence[int] = (), keys: Path | None = None) -> None:
        """Over ipc, or over tcp with one of these ports for each topic."""
        self.directory = Path(tempfile.mkdtemp(prefix="mvsgs-test-"))
        self.processes: dict[str, Process] = {}
        self._buffer = buffer
        self._ports = list(ports)
        self._topics: dict[str, str] = {}  # topic -> address
        self._keys = None if keys is None else str(keys)
        self._listeners: list[threading.Thread] = []

    def address(self, topic: str) -> str:
        if topic not in self._topics:
            ports = self._ports
            self._topics[topic] = f"tcp://127.0.0.1:{ports.pop()}" if ports else f"ipc://{self.directory}/{topic}"
        return self._topics[topic]

    def start(
        self,
        name: str,
        target: str,
        reads: Mapping[str, str],
        sends: Mapping[str, int],
        config: Mapping[str, Any] | None = None,
        **spec: Any,
    ) -> Process:
        """`reads`: message type -> slot (with "?" for best effort); `sends`: message type -> number of readers."""
        status, write_end = os.pipe()
        content = {
            "name": name,
            "target": target,
            "config": dict(config or {}),
            "inputs": [
                {
                    "type": kind,
                    "slot": slot.rstrip("?"),
                    "address": self.address(f"{slot.rstrip('?')}.{kind}"),
                    "best_effort": slot.endswith("?"),
                }
                for kind, slot in reads.items()
            ],
            "outputs": [
                {"type": kind, "address": self.address(f"{name}.{kind}"), "readers": readers}
                for kind, readers in sends.items()
            ],
            "buffer": self._buffer,
            "keys": self._keys,
            "status_fd": write_end,
        } | spec
        path = self.directory / f"{name}.json"
        path.write_text(json.dumps(content))
        log = self.directory / f"{name}.log"
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, STARTING)  # inherited: none is lost at the start
        with log.open("wb") as output:
            popen = subprocess.Popen(
                [sys.executable, "-m", "nodes", str(path)],
                env={**os.environ, **ENVIRONMENT},
                pass_fds=[write_end],
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        os.close(write_end)
        process = self.processes[name] = Process(name, popen, log)
        listener = threading.Thread(target=process.listen, args=(status,))
        listener.start()
        self._listeners.append(listener)
        return process

    def diamond(self, **configs: Mapping[str, Any]) -> None:
        """source -> left, right -> join; the join writes `joined`."""
        join = {"path": str(self.directory / "joined.json"), **configs.get("join", {})}
        here = "tests.support.sample_nodes"
        self.start("join", f"{here}.Join", {"Keyframe": "left", "GroundTruth": "right"}, {}, join)
        self.start("left", f"{here}.Left", {"Frame": "source"}, {"Keyframe": 1}, configs.get("left"))
        self.start("right", f"{here}.Right", {"Frame": "source"}, {"GroundTruth": 1}, configs.get("right"))
        self.start("source", f"{here}.Source", {}, {"Frame": 2}, configs.get("source"))

    @property
    def joined(self) -> dict[str, Any]:
        return json.loads((self.directory / "joined.json").read_text())

    @property
    def aborted(self) -> dict[str, Any]:
        return json.loads((self.directory / "joined.aborted").read_text())

    def wait(self, seconds: float = LONG) -> dict[str, int]:
        """Exit codes by node; fails if one is still running after that time."""
        limit = time.monotonic() + seconds
        for process in self.processes.values():
            try:
                process.popen.wait(max(0.01, limit - time.monotonic()))
            except subprocess.TimeoutExpired:
                logs = "\n".join(f"{p.name}: {p.last}\n{p.log.read_text()}" for p in self.processes.values())
                raise AssertionError(f"{process.name} is still running\n{logs}") from None
        for listener in self._listeners:
            listener.join(5)
        return {name: process.popen.returncode for name, process in self.processes.items()}

    def sockets(self) -> list[str]:
        return [path.name for path in self.directory.iterdir() if path.is_socket()]

    def close(self) -> None:
        for process in self.processes.values():
            process.popen.kill()
            process.popen.wait()
        for listener in self._listeners:
            listener.join(5)
        shutil.rmtree(self.directory)


@contextmanager
def graph(buffer: int = 2, ports: Sequence[int] = (), keys: Path | None = None) -> Iterator[Graph]:
    running = Graph(buffer, ports, keys)
    try:
        yield running
    finally:
        running.close()
