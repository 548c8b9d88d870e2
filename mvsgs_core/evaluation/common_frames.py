"""Which frames runs have in common: an index counts after start and stride, so that a frame is known by its time."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.evaluation import metrics
from mvsgs_core.export.cameras import Cameras, read_cameras

SAME = 1e-4  # seconds: frames of one input are farther apart

Times = Mapping[int, float]  # seconds in the input, by index


def keyframe_times(folder: Path) -> Times:
    """As `times_of`, of a run that kept its cameras; none where it did not. Raises ValueError and OSError."""
    file = folder / "cameras.json"
    return times_of(read_cameras(file)) if file.is_file() else {}


def times_of(cameras: Cameras) -> Times:
    """Of the keyframes of the run's own stream: those before have times of other inputs."""
    pairs = zip(cameras.keyframes.tolist(), cameras.timestamps.tolist())
    return {index: seconds for index, seconds in pairs if index >= 0 and np.isfinite(seconds)}


def different(reports: Sequence[Mapping[str, Any]], times: Sequence[Times]) -> str:
    """What the figures of runs are of that is not the same, and what to do, in a line; empty where nothing is known."""
    sizes = [metrics.value(report, "run.frame_size") for report in reports]
    counts = [metrics.number(report, "trajectory.frames") for report in reports]
    found = []
    if not one_input(reports):
        found.append("inputs")
    elif _several(counts) or not all(_one_stream(a, b) for a, b in combinations(times, 2)):
        found.append("frames")
    if _several([size and tuple(size) for size in sizes]):
        found.append("frame sizes")
    if not found:
        return ""
    return (
        f"these runs are of different {' and '.join(found)}: their figures do not compare; give runs of the same input "
        "with the same dataset.size, start, stop and stride"
    )


def one_input(reports: Sequence[Mapping[str, Any]]) -> bool:
    return not _several([_input(report) for report in reports])


def _input(report: Mapping[str, Any]) -> str | None:
    """As the report names it; a file or folder that is there by its one real path, however it was named."""
    named: str | None = report.get("input")
    if named is None:
        return None
    paths = named, named.partition(" ")[2]  # alone, or behind the name of a data set
    found = next((path for path in paths if os.path.exists(path)), "")  # noqa: PTH110  # raises nothing
    return named.removesuffix(found) + os.path.realpath(found) if found else named


def _several(values: Sequence[Any]) -> bool:
    return len({value for value in values if value is not None}) > 1


def _one_stream(a: Times, b: Times) -> bool:
    """Whether both can be of the same frames: together they are in order, too."""
    both = pairwise(sorted([*a.items(), *b.items()]))
    return all((after - before > SAME) if i < j else (after - before <= SAME) for (i, before), (j, after) in both)


def same_keyframes(reports: Sequence[Mapping[str, Any]], times: Sequence[Times]) -> list[dict[int, int]]:
    """Of each run, where it has the keyframes that all have: its index by that in the first."""
    shared: list[dict[int, int]] = [{} for _ in times]
    if not one_input(reports) or not all(times):
        return shared
    known = [(list(of_run), np.array(list(of_run.values()))) for of_run in times]
    for index, seconds in times[0].items():
        apart = [np.abs(stamps - seconds) for _, stamps in known]
        if all(found.min() <= SAME for found in apart):
            for of_run, (indices, _), found in zip(shared, known, apart):
                of_run[index] = indices[int(found.argmin())]
    return shared


def seconds_of(indices: np.ndarray, times: Times) -> np.ndarray:
    """(N,) of frames (N,), between two keyframes or more, evenly."""
    known, stamps = np.array(sorted(times)), np.array([times[index] for index in sorted(times)])
    spacing = (stamps[-1] - stamps[0]) / (known[-1] - known[0])
    beyond = indices - np.clip(indices, known[0], known[-1])
    return np.interp(indices, known, stamps) + spacing * beyond


__all__ = ["SAME", "Times", "different", "keyframe_times", "one_input", "same_keyframes", "seconds_of", "times_of"]
