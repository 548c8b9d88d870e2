"""The demonstration's worst frame of all, not of the held-out alone, and the one of which the map covers least.

The end of a stream is where maps fail: no later view helps its last keyframes.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from pathlib import Path
from typing import Any

from bench.runs import launch
from bench.table import Row, at_least, at_most

BEHIND = 6.0  # dB below the median frame
COVERED = 99.0  # % of the pixels
SMALL = ("dataset.size=[120,160]", "dataset.options.frames=60", "mapper.iterations=20", "mapper.refinement=100")


def measure(quick: bool) -> list[Row]:
    name = "small room" if quick else "demonstration"
    return rows(name, _report(SMALL if quick else ())["rendering"])


def rows(name: str, rendering: dict[str, Any]) -> list[Row]:
    """rendering: of a report in which all frames were scored."""
    frames = rendering["frames"]
    worst, coverage = rendering["worst"]["all"], rendering["coverage"]
    behind = statistics.median(frame["psnr"] for frame in frames) - worst["psnr"]
    return [
        Row(f"{name}: worst frame of {len(frames)}", worst["psnr"], f"dB (frame {worst['index']})"),
        at_most(f"{name}: worst frame below the median", behind, "dB", BEHIND),
        at_least(f"{name}: least covered frame", 100 * coverage["min"], f"% (frame {coverage['min_index']})", COVERED),
    ]


def _report(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Of a run in which every frame is scored. Raises CalledProcessError where it fails."""
    with tempfile.TemporaryDirectory() as folder:
        launch(f"output={folder}/out", "device=cpu", "screen=off", "evaluator.lpips=off", *overrides)
        report: dict[str, Any] = json.loads(Path(folder, "out", "report.json").read_text())
    return report
