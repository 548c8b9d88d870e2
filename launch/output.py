"""The directory of a run's results: one run at a time, nothing of two runs mixed, a report that is always true.

`report.json` says `"finished": false` from the start, so that it holds whatever befalls the launcher; the evaluator's
own report takes its place at the end, still with `false` where a stage elsewhere may still work.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from launch.outcome import Outcome
from launch.refusal import GraphError
from launch.settings_file import write_settings
from mvsgs_core.atomic_file import parts_of, replace_text
from mvsgs_core.kept_map import FOLDER, TRACKER
from mvsgs_core.mapping.checkpoints.files import KEYFRAMES, checkpoint_info
from mvsgs_core.passwords import without_passwords
from mvsgs_core.run_folder import CONFIG, has_settings
from mvsgs_core.shared_folder import HOME, refusal, shared

LOCK, PREVIOUS, REPORT = ".lock", "previous", "report.json"
FOUND = ("map.ply", "localization.csv")  # either, a checkpoint or a pose is worth keeping of an earlier run
IMAGES, TRAJECTORY = "keyframes", "trajectory.txt"
RESULTS = (  # all that a run leaves, but for the two files that say that it is one's
    *FOUND, FOLDER, TRAJECTORY, "report.html", "comparison.png", "cameras.json", "transforms.json", IMAGES,
    "georeference.json", "given_frame.json",
)  # fmt: skip
RUN_ALL = Path(__file__).resolve().parent / "run_all.py"


class Output:
    """A claimed output directory."""

    def __init__(self, path: Path, *, resumable: bool = True) -> None:
        """resumable: such a run can be gone on with. Raises GraphError where the directory cannot be made, where others
        than a run keep their files, or where another run is writing to it."""
        self.path, self._resumable = path, resumable
        self.resume: str | None = None  # the command that goes on with the run, once it has ended early
        make_folder(path)
        try:
            self._lock = _lock(path / LOCK)
        except BlockingIOError as error:
            raise GraphError(
                f"output={path}: another run (process {error.args[0]}) is writing there; give another output=DIR"
            ) from None
        except OSError as error:
            raise GraphError(f"output={path}: {error.strerror}") from error

    def begin(self, config: Mapping[str, Any], command: str, *, resumed: bool) -> str | None:
        """Moves what an earlier run found aside (a resumed one's stays), and writes this run's configuration, under the
        command that composed it. Returns where what was moved is.

        Raises GraphError where that cannot be written.
        """
        try:
            self._remove_parts()
            aside = None if resumed else self._move_previous()
            self.write_report({"finished": False, "reason": "still running, or killed with its launcher"})
            write_settings(self.path / CONFIG, config, command)
            return f"what the run before found is now in {aside} ({self._previous()})" if aside else None
        except OSError as error:
            raise GraphError(f"output={self.path}: {error.strerror or error}") from error

    def settle(self, outcome: Outcome, *, scored: bool = False, keep: bool = True) -> str | None:
        """Writes how the run ended, where no evaluator's report does; over that report, too, where the end of a stage
        elsewhere is not known. `scored`: the graph has who writes one. What the run could go on from goes once nothing
        is left to do, unless it is to be kept.

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
        said = {"observers": alone, "nothing": dict(outcome.nothing), "cut_off": dict(outcome.cut_off)}
        beside = {key: by_node for key, by_node in said.items() if by_node}
        there = read_report(self.path)
        if there and there.get("finished", True) and not outcome.unseen:
            if not beside.items() <= there.items():
                self.write_report(there | beside)
            return
        report = {**there, "finished": False, "reason": outcome.reason, **beside}
        if outcome.failed:
            report |= {"failed": outcome.failed.node, "error": outcome.failed.error}
        if outcome.whole:
            report["map"] = "none" if outcome.nothing else "finished"
            failed = ", ".join(f"{node} failed: {error}" for node, error in alone.items())
            report["reason"] = failed or ("no report came" if scored else "no slot of this graph writes a report")
            report["finished"] = not scored
        if not report["finished"]:
            report["resume"] = self.resume = _resume_command(self.path) if self._resumable else None
        self.write_report(report)

    def write_report(self, content: Mapping[str, Any]) -> None:
        """Raises OSError."""
        stamp = {"written": time.strftime("%Y-%m-%d %H:%M:%S %z")}
        replace_text(self.path / REPORT, json.dumps(without_passwords({**content, **stamp}), indent=1) + "\n")

    def release(self) -> None:
        (self.path / LOCK).unlink(missing_ok=True)
        os.close(self._lock)

    def _remove_parts(self) -> None:
        """Of processes that were killed while they wrote a file: nobody else writes here now, the folder is locked."""
        checkpoint = self.path / FOLDER
        files = [self.path / name for name in (*RESULTS, REPORT, CONFIG)]
        images = [folder / "*.png" for folder in (self.path / IMAGES, checkpoint / KEYFRAMES)]
        for file in (*files, checkpoint / TRACKER, checkpoint / "state-*.npz", *images):
            for part in parts_of(file):
                part.unlink(missing_ok=True)

    def _move_previous(self) -> Path | None:
        """What an earlier run found goes to a folder of its own, which is returned, so that no run takes another's
        place; what it left without having found anything goes, as it would pass for this run's."""
        if not is_of_a_run(self.path):
            return None
        if not _worth_keeping(self.path):
            _remove_results(self.path)
            return None
        aside = next(folder for folder in _numbered(self.path / PREVIOUS) if not folder.exists())
        aside.mkdir()
        for name in (REPORT, CONFIG):  # copies: at any time both folders say whose they are
            with suppress(FileNotFoundError):
                shutil.copy2(self.path / name, aside / name)
        for name in RESULTS:
            if (self.path / name).exists():
                (self.path / name).rename(aside / name)
        if (report := read_report(aside)).get("resume"):  # from there, now
            replace_text(aside / REPORT, json.dumps(report | {"resume": _resume_command(aside)}, indent=1) + "\n")
        return aside

    def _previous(self) -> str:
        """How many earlier runs' results lie beside this one's, and how large they are."""
        kept = [folder for folder in self.path.glob(f"{PREVIOUS}*") if is_of_a_run(folder)]
        size = sum(file.stat().st_size for folder in kept for file in folder.rglob("*") if file.is_file())
        return f"{len(kept)} of them, " + (f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB")


def make_folder(path: Path) -> None:
    """The folder that a run, or a sweep's runs, write in. Raises GraphError where it cannot be made or written in, and
    where others than runs keep their files."""
    try:
        if found := file_in_the_way(path) or _of_all(path):
            raise GraphError(f"output={path}: {found}")
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()  # leaves nothing
    except OSError as error:
        raise GraphError(f"output={path}: {error.strerror or error}") from error


def file_in_the_way(folder: Path) -> str | None:
    """Why there can be no such folder, as a file is in its place, or in that of one above. Raises OSError."""
    for place in (folder, *folder.parents):
        if place.exists() and not place.is_dir():
            return f"{'' if place == folder else f'{place} '}is a file; give the name of a folder"
    return None


def _of_all(folder: Path) -> str | None:
    """Why a run's files are not to lie in that folder itself; in the home a run may go on that was begun there."""
    what = shared(folder)
    if what is None or (what == HOME and is_of_a_run(folder)):
        return None
    return refusal(folder, what, "a run")


def _resume_command(output: Path) -> str | None:
    """What goes on with an unfinished run; None where it left no checkpoint, or none but the map that it began on."""
    try:
        found = checkpoint_info(output)
    except ValueError:
        return None
    if found.newest_keyframe_index < 0 and not found.finished:
        return None
    return shlex.join([sys.executable, str(RUN_ALL), f"resume={output}"])


def new_folder(path: Path) -> Path:
    """Makes a folder of this name, or with the first number behind it that none has: of runs that begin in the same
    second each gets its own. Raises GraphError."""
    for folder in _numbered(path):
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            if folder.exists():
                continue
            raise GraphError(f"output={folder}: {error.strerror}") from error
        return folder
    raise AssertionError("there is always another number")


def others_files(output: Path) -> list[str]:
    """What lies there under the name of a run's results, and no run has left: it is not ours to replace."""
    if is_of_a_run(output):
        return []
    return [name for name in (*RESULTS, REPORT, CONFIG) if (output / name).exists()]


def is_of_a_run(output: Path) -> bool:
    """Whether a run has written there: its report or its settings say so."""
    return "finished" in read_report(output) or has_settings(output)


def _worth_keeping(output: Path) -> bool:
    if any((output / name).exists() for name in FOUND) or _has_a_pose(output / TRAJECTORY):
        return True
    try:
        checkpoint_info(output)
    except ValueError:
        return False
    return True


def _has_a_pose(trajectory: Path) -> bool:
    try:
        with trajectory.open("rb") as lines:
            return any(line.strip() and not line.startswith(b"#") for line in lines)
    except OSError:
        return False


def _remove_results(output: Path) -> None:
    """Files and folders of our names; of folders only what has our names in them."""
    for name in RESULTS:
        if (output / name).is_file():
            (output / name).unlink()
    checkpoint = output / FOLDER
    for file in (*checkpoint.glob("state-*.npz"), checkpoint / TRACKER, *(output / IMAGES).glob("*.png")):
        file.unlink(missing_ok=True)
    shutil.rmtree(checkpoint / KEYFRAMES, ignore_errors=True)
    for folder in (checkpoint, output / IMAGES):
        with suppress(OSError):
            folder.rmdir()


def _numbered(folder: Path) -> Iterator[Path]:
    """previous, previous-2, previous-3 and so on."""
    yield folder
    for number in count(2):
        yield folder.with_name(f"{folder.name}-{number}")


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
