"""Live status of a node for its launcher: JSON lines on a pipe, twice a second and at every change of state."""

from __future__ import annotations

import json
import logging
import os
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

INTERVAL = 0.5  # s
LAST_WORDS = 2.0  # s that the launcher has to take the last line


class Status:
    """Writes `snapshot()` to `fd` from a thread of its own: busy node and slow launcher do not hold each other up."""

    def __init__(self, fd: int | None, snapshot: Callable[[], dict[str, Any]]) -> None:
        self._fd = fd
        self._snapshot = snapshot
        self._state: dict[str, Any] = {"state": "starting"}  # with its details: the error of a failure
        self._news: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="status", daemon=True)
        if fd is not None:
            self._thread.start()

    def set(self, state: str, **details: Any) -> None:
        self._state = {"state": state} | details
        logging.info("%s", " ".join([state, *(str(details[key]) for key in ("error",) if key in details)]))
        if self._fd is not None:
            self._news.put(self._line())

    def close(self) -> None:
        """Writes the last figures, and waits a little until the launcher has taken them."""
        if self._fd is not None:
            self._news.put(self._line())
            self._news.put(None)
            self._thread.join(LAST_WORDS)

    def _line(self) -> dict[str, Any]:
        return self._state | self._snapshot() | {"bytes": rss()}

    def _write(self) -> None:
        while True:
            try:
                line = self._news.get(timeout=INTERVAL)
            except queue.Empty:
                line = self._line()
            if line is None:
                return
            text = memoryview(json.dumps(line, default=str).encode() + b"\n")
            try:
                while text:
                    text = text[os.write(self._fd or 0, text) :]
            except BrokenPipeError:
                logging.critical("the launcher is gone")
                os._exit(1)


def rss() -> int:
    """Resident memory of this process, bytes."""
    return _kilobytes("VmRSS") * 1024


def peak_bytes() -> int:
    """Largest resident memory of this process so far, bytes."""
    return _kilobytes("VmHWM") * 1024


def _kilobytes(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    return 0
