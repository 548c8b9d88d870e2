"""What a report is of: the input, its camera, the command line and its settings, the version, the machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core import machine
from mvsgs_core.export.source_camera import source_camera
from mvsgs_core.trajectory import Trajectory

SETTINGS = "config.yaml"  # the launcher leaves it in the output: comments with the command line, then all parameters
_LONGEST = 2**20  # bytes of settings that are shown


def origin(
    folder: Path | None, size: tuple[int, int] | None, trajectory: Trajectory | None, statistics: Mapping[str, Any]
) -> dict[str, Any]:
    """`run` of the report. size: (height, width) of the frames; statistics: of all nodes upstream, by name."""
    command, settings = _settings(folder)
    camera = source_camera(statistics)
    return {
        "output": None if folder is None else str(folder.absolute()),
        "command": command,
        "settings": settings,
        "frame_size": None if size is None else list(size),
        "stream_seconds": None if trajectory is None else _seconds(trajectory.timestamp),
        "camera": None if camera is None else camera.text(),
        "machine": machine.described(),
    }


def in_words(report: Mapping[str, Any]) -> dict[str, str]:
    """What the report has of it at its head; what is not known is left out."""
    run, frames = report.get("run", {}), report["trajectory"]["frames"]
    seconds, size = run.get("stream_seconds"), run.get("frame_size")
    stream = [f"{frames} frames"] if frames else []
    stream += [f"{seconds:.1f} s"] if seconds else []
    stream += [f"mapped at {size[1]}x{size[0]} pixels"] if size else []
    listed = {
        "input": report.get("input"), "stream": ", ".join(stream), "camera": run.get("camera"),
        "finished": report.get("date"), "command": run.get("command"), "output": run.get("output"),
        "version": report.get("version"),
        **run.get("machine", {}),
    }  # fmt: skip
    return {name: str(value) for name, value in listed.items() if value}


def _settings(folder: Path | None) -> tuple[str | None, str | None]:
    """The command line and all settings of the run that writes to the folder; None where they are not there."""
    try:
        text = (folder / SETTINGS).read_bytes()[:_LONGEST].decode(errors="replace") if folder else ""
    except OSError:
        text = ""
    lines = text.splitlines()
    comments = [line.lstrip("# ") for line in lines if line.startswith("#")]
    rest = "\n".join(line for line in lines if not line.startswith("#"))
    return " ".join(comments) or None, rest or None


def _seconds(timestamps: np.ndarray) -> float | None:
    """Of a stream with frames at these times (N,)."""
    known = timestamps[np.isfinite(timestamps)]
    return float(known.max() - known.min()) if len(known) > 1 else None


__all__ = ["SETTINGS", "in_words", "origin"]
