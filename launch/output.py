"""The directory of a run's results: one run at a time, nothing of two runs mixed, a report that is always true.

`report.json` says `"finished": false` from the start, so that it holds whatever befalls the launcher; the evaluator's
own report takes its place at the end.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from launch.outcome import Outcome
from launch.refusal import GraphError
from launch.settings_file import write_settings
from mvsgs_core.atomic_file import replace_text
from mvsgs_core.kept_map import FOLDER
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.passwords import without_passwords

LOCK, PREVIOUS, REPORT = ".lock", "previous", "report.json"
MAP = ("map.ply", "trajectory.txt", "localization.csv", FOLDER)  # what is worth keeping of an earlier run
BESIDE = (  # and what belongs to it
    "report.html", REPORT, "comparison.png", "cameras.json", "transforms.json", "keyframes", "config.yaml",
    "georeference.json",
)  # fmt: skip
RUN_ALL = Path(__file__).resolve().parent / "run_all.py"


class Output:
    """A claimed output directory."""

    def __init__(self, path: Path) -> None:
        """Raises GraphError where it cannot be made, or where another run is writing to it."""
        self.path = path
        self.resume: str | None = None  # the command that goes on with the run, once it has ended early
        if path.exists() and not path.is_dir():
            raise GraphError(f"output={path}: is a file; the output is a folder")
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = _lock(path / LOCK)
        except BlockingIOError as error:
            raise GraphError(
                f"output={path}: another run (process {error.args[0]}) is writing there; give another output=DIR"
            ) from None
        except OSError as error:
            raise GraphError(f"output={path}: {error.strerror}") from error

    def begin(self, config: Mapping[str, Any], command: str, *, resumed: bool) -> None:
        """Moves an earlier run's results aside (a resumed one's stay), and writes this run's configuration, under the
        command that composed it.

        Raises GraphError where that cannot be written.
        """
        try:
            if not resumed:
                self._move_previous()
            self.write_report({"finished": False, "reason": "still running, or killed with its launcher"})
            write_settings(self.path / "config.yaml", config, command)
        except OSError as error:
            raise GraphError(f"output={self.path}: {error.strerror or error}") from error

    def settle(self, outcome: Outcome, *, scored: bool = False, keep: bool = True) -> str | None:
        """Writes how the run ended, where no evaluator's report does. `scored`: the graph has who writes one. What the
        run could go on from goes once nothing is left to do, unless it is to be kept.

        What went wrong where that cannot be written, else None.
        """
        try:
            self._settle(outcome, scored)
            if not keep and read_report(self.path).get("finished"):
                shutil.rmtree(self.path / FOLDER, ignore_errors=True)
        except OSError as error:
            return f"{self.path / REPORT} cannot be written: {error.strerror or error}"
        return None

    def _settle(self, outcome: Outcome, scored: bool) -> None:
        alone = {failure.node: failure.error for failure in outcome.observers}
        beside = ({"observers": alone} if alone else {}) | (
            {"nothing": dict(outcome.nothing)} if outcome.nothing else {}
        )
        report = read_report(self.path)
        if report and report.get("finished", True):
            if not beside.items() <= report.items():
                self.write_report(report | beside)
            return
        report = {"finished": False, "reason": outcome.reason, **beside}
        if outcome.failed:
            report |= {"failed": outcome.failed.node, "error": outcome.failed.error}
        if outcome.whole:
            report["map"] = "none" if outcome.nothing else "finished"
            failed = ", ".join(f"{node} failed: {error}" for node, error in alone.items())
            report["reason"] = failed or ("no report came" if scored else "no slot of this graph writes a report")
            report["finished"] = not scored
        if not report["finished"]:
            report["resume"] = self.resume = self._resume_command()
        self.write_report(report)

    def write_report(self, content: Mapping[str, Any]) -> None:
        """Raises OSError."""
        stamp = {"written": time.strftime("%Y-%m-%d %H:%M:%S %z")}
        replace_text(self.path / REPORT, json.dumps(without_passwords({**content, **stamp}), indent=1) + "\n")

    def _resume_command(self) -> str | None:
        """What goes on with an unfinished run; None where it left no checkpoint."""
        try:
            checkpoint_info(self.path)
        except ValueError:
            return None
        return shlex.join([sys.executable, str(RUN_ALL), f"resume={self.path}"])

    def release(self) -> None:
        (self.path / LOCK).unlink(missing_ok=True)
        os.close(self._lock)

    def _move_previous(self) -> None:
        if not any((self.path / name).exists() for name in MAP):
            (self.path / "report.html").unlink(missing_ok=True)  # of a run without a map: it would pass for this one's
            return
        previous = self.path / PREVIOUS
        shutil.rmtree(previous, ignore_errors=True)
        previous.mkdir()
        for name in (*MAP, *BESIDE):
            if (self.path / name).exists():
                (self.path / name).rename(previous / name)


def read_report(output: Path) -> dict[str, Any]:
    """report.json; empty where there is none that can be read."""
    try:
        found = json.loads((output / REPORT).read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _lock(path: Path) -> int:
    """A descriptor that holds the lock. Raises BlockingIOError, with the holder's process id, where another has it."""
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(lock).st_ino == path.stat().st_ino:  # else the last holder has just removed the file
                os.ftruncate(lock, 0)
                os.write(lock, str(os.getpid()).encode())
                return lock
        except BlockingIOError:
            holder = os.read(lock, 32).decode(errors="replace") or "unknown"
            os.close(lock)
            raise BlockingIOError(holder) from None
        except FileNotFoundError:
            pass
        os.close(lock)
