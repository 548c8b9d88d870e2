"""Sequences as recordings of small raw frames: to play them costs next to nothing, as a camera does."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.pieces import Kept
from bench.runs import DATA
from nodes.reader import Reader
from nodes.recorder import Recorder

SIZE = [240, 320]
SCENES: dict[str, dict[str, Any]] = {  # what the reader is given; the pace is the sequence's own
    "tum_fr1_xyz": {"name": "tum", "path": DATA / "tum_fr1_xyz", "size": SIZE},
    "redkitchen": {"name": "seven_scenes", "path": DATA / "seven_scenes_redkitchen", "size": SIZE},
    "hololens_000": {"name": "tum", "path": DATA / "hololens_000", "size": 240 * 320},  # at its own aspect
    "room": {"name": "synthetic", "size": SIZE, "options": {"scene": "room"}},
    "loop": {"name": "synthetic", "size": SIZE, "options": {"scene": "room", "loop": True, "frames": 240}},
}


def available() -> list[str]:
    """The scenes whose data are here."""
    return [name for name, given in SCENES.items() if "path" not in given or Path(str(given["path"])).exists()]


def recording(scene: str, folder: Path, stop: int | None = None) -> Path:
    """The file of a scene, up to frame `stop`, made where it is not there yet, or is of another reader or size."""
    path = folder / f"{scene}{'' if stop is None else f'_{stop}'}.mcap"
    kept, asked = Kept(True), json.loads(json.dumps({**SCENES[scene], "stop": stop}, default=str))
    if not kept.has(path, asked):
        write(Reader(Reader.Config(**SCENES[scene], stop=stop)).run(), path)
        kept.keep(path, asked)
    return path


def write(messages: Iterable[Any], file: Path) -> Path:
    """A recording of messages, for the player; the file is there once it is whole."""
    aside = file.with_suffix(".part")
    aside.unlink(missing_ok=True)
    recorder = Recorder(Recorder.Config(path=str(aside), foxglove=False))
    for message in messages:
        recorder.on_message(message)
    list(recorder.on_end())
    return aside.rename(file)


__all__ = ["SCENES", "available", "recording", "write"]
