"""What a kept map lacks whose run has not reached its end: the tracker writes its half before the mapper is done."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from mvsgs_core.kept_map import tracker_file
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.tracking import known_map


def what_is_missing(output: Path | str) -> str | None:
    """In words, with what finishes it; None: nothing, or nothing that can be told without the tracker's half.

    Raises ValueError where the mapper's half is not there.
    """
    report = _report(Path(output))
    if report and (report.get("finished") is not False or report.get("map") == "finished"):
        return None
    splats = checkpoint_info(output)
    try:
        keyframes = {keyframe.index for keyframe in known_map.load(tracker_file(output)).keyframes}
    except ValueError:  # the tracker refuses it
        return None
    if not report and max(keyframes) <= splats.newest_keyframe_index:  # saved while a stream went on: it is whole
        return None
    with_splats = len(keyframes.intersection(splats.keyframes.tolist()))
    lacks = f"{with_splats} of the tracker's {len(keyframes)} keyframes have splats"
    if with_splats == len(keyframes) and splats.finished:
        lacks = "its final refinement may be missing"
    return f"its run has not reached its end, {lacks}; {_what_to_do(Path(output), report)}"


def _what_to_do(output: Path, report: dict[str, Any]) -> str:
    if not report:
        return "it is a copy of an unfinished run's: finish that one, and copy it again"
    if report.get("resume", "") is None:
        return "it cannot be gone on with: run it again"
    return f"finish it first: mvsgs resume={shlex.quote(str(output))}"


def _report(output: Path) -> dict[str, Any]:
    """The run's; empty where there is none, as for a map that was saved on request."""
    try:
        found = json.loads((output / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


__all__ = ["what_is_missing"]
