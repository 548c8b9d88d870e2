"""Files of every kind that is read, mutated, opened and read to their end: only documented errors, in bounds."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.faults.file_mutations import mutated
from bench.faults.file_seeds import HOSTILE, SEEDS
from bench.table import Row, at_least, at_most

FILES, QUICK_FILES = 3000, 90
TIMEOUT = 20.0  # s for one file: a sound one takes a few milliseconds
MEMORY = 400.0  # MB for one file: what an image or a message of the largest allowed size takes
SEED = 20


class _Worker:
    """`bench.faults.file_worker` as a process, started again where a file ended it."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def read(self, way: str, path: Path) -> dict[str, Any]:
        """What came of the file; {"ended": how} where the worker did not outlive it."""
        if self._process is None:
            command = [sys.executable, "-m", "bench.faults.file_worker"]
            quiet = {**os.environ, "OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=quiet
                )
            self.read("ply", Path("/nonexistent"))  # its imports are not the file's time
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):  # it has ended since: there is no answer
            process.stdin.write(json.dumps({"way": way, "path": str(path)}).encode() + b"\n")
            process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], TIMEOUT if path.exists() else 10 * TIMEOUT)
        line = process.stdout.readline() if ready else b""
        if line:
            answer: dict[str, Any] = json.loads(line)
            return answer
        self._end()
        return {"ended": f"killed by signal {-process.returncode}" if ready else f"not done after {TIMEOUT:g} s"}

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            with suppress(BrokenPipeError):
                self._process.communicate()  # closes its pipes and waits for it
            self._process = None


def _mutate_one(folder: Path, rng: np.random.Generator) -> str:
    """Mutates one of the folder's files; those of text are as likely as all others together."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    pictures = [p for p in files if p.suffix in (".jpg", ".png", ".tif", ".webp", ".bmp", ".ppm")]
    others = [p for p in files if p not in pictures]
    chosen = pictures if not others or (pictures and rng.random() < 0.3) else others
    path = chosen[int(rng.integers(len(chosen)))]
    path.write_bytes(mutated(path.read_bytes(), rng))
    return path.name


def measure(quick: bool) -> list[Row]:
    count = QUICK_FILES if quick else FILES
    outcomes: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name, _Worker(Path(name) / "log") as worker:
        root = Path(name)
        for number, (kind, (way, target, make)) in enumerate(SEEDS.items()):
            seed = root / f"seed{number}"
            seed.mkdir()
            make(seed)
            sound = worker.read(way, seed / target)
            if sound.get("error") or not sound.get("frames"):
                raise RuntimeError(f"the sound {kind} cannot be read: {sound}")
        for number, (kind, (way, target, make)) in enumerate(HOSTILE.items()):
            hostile = root / f"hostile{number}"
            hostile.mkdir()
            make(hostile)
            outcomes.append({"kind": kind, "hostile": True, **worker.read(way, hostile / target)})
        for number in range(count):
            which = number % len(SEEDS)
            kind, (way, target, _) = list(SEEDS.items())[which]
            folder = root / "mutated"
            shutil.copytree(root / f"seed{which}", folder)
            changed = _mutate_one(folder, np.random.default_rng([SEED, number]))
            outcome = {"kind": kind, "file": changed, "number": number, **worker.read(way, folder / target)}
            outcomes.append(outcome)
            shutil.rmtree(folder)
    for o in outcomes:
        if "ended" in o or not o["documented"]:
            print(f"file {o.get('number')}, {o['kind']}, {o.get('file')}: {o.get('ended') or o['traceback']}")
    return _rows(outcomes)


def _rows(outcomes: list[dict[str, Any]]) -> list[Row]:
    through = [o for o in outcomes if "ended" not in o]
    max_memory = max(through, key=lambda o: o["bytes"])
    slowest = max(through, key=lambda o: o["seconds"])
    hostile = [o for o in outcomes if o.get("hostile")]
    read = sum(bool(o.get("frames")) for o in hostile)
    refused = Counter(o["error"].partition(":")[0] for o in through if o["error"])
    kinds = len({o["kind"] for o in outcomes})
    return [
        Row("files mutated and read through", len(outcomes) - len(hostile), f"of {kinds - len(hostile)} kinds"),
        at_least("hostile files of which the sound part is read", read, f"of {len(hostile)}", len(hostile)),
        at_most("undocumented errors", sum(not o["documented"] for o in through), "", 0),
        at_most("processes that crashed or hung", len(outcomes) - len(through), "", 0),
        at_most("errors that are no plain text", sum(not o.get("plain", True) for o in through), "", 0),
        Row("refused", ", ".join(f"{n} {name}" for name, n in sorted(refused.items()))),
        Row("read in spite of it", sum(o["error"] is None for o in through), "files"),
        at_most("largest memory", max_memory["bytes"] / 1e6, f"MB, {max_memory['kind']}", MEMORY),
        at_most("longest time", slowest["seconds"], f"s, {slowest['kind']}", TIMEOUT),
    ]
