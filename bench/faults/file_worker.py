"""Opens files that may do damage, in a process of its own: one JSON line in, one out, until there are no more.

Its memory is bounded, and what each file takes of it is measured (on Linux, where the peak can be set back).
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.export.ply import read_ply
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.networks.checkpoints import read
from nodes.player import Player

ADDRESS_SPACE = 4 * 2**30  # bytes beyond those of a fresh worker
_ROOT = Path(__file__).resolve().parents[2]


def read_through(way: str, path: Path) -> int:
    """Reads a file or folder to its end. Returns the number of frames, or 1. Raises what reading it raises."""
    if way == "recording":
        return sum(1 for _ in Player(Player.Config(str(path))).run())
    if way == "ply":
        return int(len(read_ply(path).splats) >= 0)
    if way == "cameras":
        return len(read_cameras(path))
    if way == "checkpoint":
        return len(checkpoint_info(path).keyframes)
    if way == "weights":
        return int(bool(read(path, inside="state_dict")))
    options: dict[str, Any] = {"intrinsics": "auto"} if way == "video" else {}
    sequence = open_dataset(way, path=path, size=(24, 32), **options)
    if len(sequence) < 0:
        raise AssertionError("no length is below zero")
    return sum(1 for _ in sequence)


def documented(error: Exception) -> bool:
    """What the readers promise: BadFileError, a missing file, or a ValueError that our own code raises in words."""
    if isinstance(error, BadFileError | FileNotFoundError | IsADirectoryError):
        return True
    frames = traceback.extract_tb(error.__traceback__)
    return type(error) is ValueError and Path(frames[-1].filename).is_relative_to(_ROOT / "mvsgs_core")


def _attempt(way: str, path: Path) -> dict[str, Any]:
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak is from here on
    began = time.perf_counter()
    answer: dict[str, Any] = {"frames": 0, "error": None, "documented": True}
    try:
        answer["frames"] = read_through(way, path)
    except Exception as error:
        text = str(error)
        answer |= {"error": f"{type(error).__name__}: {text[:300]}", "documented": documented(error)}
        answer["plain"] = len(text) < 4000 and all(c.isprintable() or c == "\n" for c in text)
        if not answer["documented"]:
            answer["traceback"] = "".join(traceback.format_tb(error.__traceback__))[-2000:] + answer["error"]
    return answer | {"seconds": time.perf_counter() - began, "bytes": _status("VmHWM") - before}


def _status(name: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


def main() -> None:
    warnings.simplefilter("ignore")  # of parsers about damage, which is what they are given
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what parsers print is no answer
    resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize") + ADDRESS_SPACE,) * 2)
    for line in sys.stdin:
        job = json.loads(line)
        print(json.dumps(_attempt(job["way"], Path(job["path"]))), file=answers)


if __name__ == "__main__":
    main()
