"""One node's process as the launcher sees it: started, listened to, stopped."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil

from launch.outcome import Failure
from launch.status import NodeStatus, printable_lines
from nodes.runtime.signals import STARTING

ROOT = Path(__file__).resolve().parent.parent


def python_environment() -> dict[str, str]:
    """Where a node's interpreter finds modules: in the repository and what PYTHONPATH names, not where it starts."""
    named = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    return {"PYTHONPATH": os.pathsep.join(dict.fromkeys([str(ROOT), *named])), "PYTHONSAFEPATH": "1"}


class Child:
    """A running node."""

    def __init__(
        self, status: NodeStatus, spec: Path, pipe: tuple[int, int], log: Path, environment: dict[str, str]
    ) -> None:
        """Starts `python -m nodes spec`; `pipe` is (read end, write end) of its status, whose number the spec names."""
        self.status = status
        self.log = log
        self.pipe = pipe[0]
        self.heard = self.moved = time.monotonic()  # when it last said anything, and when it last got on with its work
        self._text = b""
        # These signals wait, blocked, until the node can handle them. Its own process group: the terminal's Ctrl-C
        # reaches only the launcher, which decides whom to stop. The same session for all: Linux with autogroups shares
        # cores between sessions first, and niceness decides nothing between them, nor who waits how long for a core.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, STARTING)
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "nodes", str(spec)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=[pipe[1]],
                process_group=0,
                env={**os.environ, **python_environment(), "PYTHONUNBUFFERED": "1", **environment},
            )
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.close(pipe[1])
        os.set_blocking(self.pipe, False)

    @property
    def name(self) -> str:
        return self.status.name

    def read_status(self) -> bool:
        """Folds in what the node wrote. False once it has closed its end, as it does when it is gone."""
        while True:
            try:
                news = os.read(self.pipe, 1 << 16)
            except BlockingIOError:
                return True
            if not news:
                return False
            *lines, self._text = (self._text + news).split(b"\n")
            self.heard = time.monotonic()
            before = self.status.done_so_far
            for line in filter(None, lines):
                self.status.update(line)
            if self.status.done_so_far != before:
                self.moved = self.heard

    def failure(self) -> str | None:
        """What went wrong, or None as long as nothing did."""
        code = self.code
        if self.status.state in ("failed", "stopped"):
            return self.status.error or "failed"
        if code is None or code == 0:
            return None
        if code < 0:
            hint = "; out of memory?" if code == -signal.SIGKILL else ""
            return f"killed by signal {-code} ({signal.strsignal(-code)}{hint})"
        return f"exit code {code}"

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs. What it has started goes with it, while the group's number is still its:
        of a process that has ended and was asked for its code, another may get it."""
        if self.process.returncode is None:
            with suppress(ChildProcessError):  # where SIGCHLD is ignored, none waits to be asked
                if os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
                    return None
                self.kill_group()
            self.process.poll()
        return self.process.returncode

    @property
    def running(self) -> bool:
        return self.code is None

    def wait(self, seconds: float = math.inf) -> None:
        """Until it has ended, at most so long."""
        until = time.monotonic() + seconds
        while self.running and time.monotonic() < until:
            time.sleep(0.005)

    @property
    def frozen(self) -> bool:
        """Whether its process was stopped by a signal, or by a debugger."""
        try:
            return psutil.Process(self.process.pid).status() in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
        except psutil.Error:
            return False

    def failed(self, error: str = "") -> Failure:
        """Its failure, as it is reported."""
        return Failure(self.name, error or self.failure() or "failed", self.last_words(), self.log)

    def last_words(self, lines: int = 30) -> str:
        """The traceback that the node reported, "" where it could explain itself without; else the end of its log."""
        if self.status.traceback is not None:
            return self.status.traceback.rstrip()
        return printable_lines(self.log.read_text(errors="replace"), lines)

    def send(self, number: signal.Signals) -> None:
        if self.running:
            os.kill(self.process.pid, number)

    def kill_group(self) -> None:
        """SIGKILL for the node and whatever it started itself; done already where it is known to have ended."""
        if self.process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)

    def close(self) -> None:
        os.close(self.pipe)
