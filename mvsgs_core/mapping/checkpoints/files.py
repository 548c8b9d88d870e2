"""The files of a checkpoint and what can be known of them without a mapper: no torch here, for the launcher too.

    OUTPUT/checkpoint/state-00000007.npz    all that goes on, newest number last; the one before is kept
    OUTPUT/checkpoint/keyframes/*.png       the keyframes' images, each written once; its name ends in its checksum

    OUTPUT/checkpoint/tracker.npz           of a map that is kept: what the tracker needs to go on in it

A state is arrays and JSON, see `array_file`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.array_file import read_arrays, write_arrays
from mvsgs_core.kept_map import FOLDER
from mvsgs_core.mapping.checkpoints.pixels import read_pixels

KEYFRAMES = "keyframes"
FORMAT, VERSION = "mvsgs checkpoint", 10
NEIGHBORS = 16  # keyframes before the newest one that stereo and fusion of the next ones may look at, at most


@dataclass(frozen=True)
class CheckpointInfo:
    """What a checkpoint says of itself."""

    file: Path  # its state
    newest_keyframe_index: int  # frame index of the newest keyframe that went into the map; -1: none
    stream_seconds: float  # timestamp of that keyframe
    keyframes: np.ndarray  # (K,) int64 frame indices of all mapped keyframes, ascending
    splats: int  # of the largest part of the map
    finished: bool  # the stream had ended: only the final refinement is left

    def stereo_after(self, keyframes: int = NEIGHBORS) -> int | None:
        """Frame index up to which no stereo is needed any more: what `mvs.resume_after` takes.

        `keyframes` newest ones get depth again, as neighbors of those that come next. None: all need it.
        """
        return int(self.keyframes[-keyframes - 1]) if len(self.keyframes) > keyframes else None


def checkpoint_info(output: Path | str) -> CheckpointInfo:
    """Of the newest whole checkpoint in a run's output directory, which is the one that `load` takes: images are read
    here, too, where an older one does without them. Raises ValueError saying what is wrong.

    To go on where the source can be read again: the same graph from the stream's beginning, with `mapper.resume=output`
    and, where the node has that parameter, `mvs.resume_after=info.stereo_after()`. The tracker finds its poses again,
    keyframes that are mapped already are passed over. Where it cannot, or `finished`: `dataset=resumed
    dataset.path=output mapper.resume=output mapper.reads={FusedKeyframe: dataset, Poses: dataset}`, tracker, mvs and
    depth_fusion off, and the evaluator's Trajectory and FusedKeyframe from dataset.
    """
    problems, files = [], state_files(Path(output))
    for k, file in enumerate(files):
        try:
            return _info(file, files[k + 1 :])
        except ValueError as error:
            problems.append(str(error))
    raise ValueError("; ".join(problems) or nothing_there(Path(output)))


def nothing_there(output: Path) -> str:
    if not output.is_dir():
        return f"{output} is no directory: give the output directory of a run"
    return (
        f"{output / FOLDER} has no checkpoint: the run ended before its first map, had mapper.checkpoint=0, or was "
        "finished (the checkpoint is removed then, unless keep_map=true)"
    )


def state_files(output: Path) -> list[Path]:
    """The states in a run's output directory, the newest first."""
    numbered = [(number_of(file), file) for file in (output / FOLDER).glob("state-*.npz")]
    return [file for number, file in sorted(numbered, reverse=True) if number >= 0]


def state_file(output: Path, number: int) -> Path:
    return output / FOLDER / f"state-{number:08d}.npz"


def number_of(file: Path) -> int:
    """Of a state file; -1: it is none."""
    found = re.fullmatch(r"state-(\d{8,12})\.npz", file.name, re.ASCII)
    return int(found[1]) if found else -1


def write_state(path: Path, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Raises OSError; ValueError for a number in `meta` that is not finite."""
    write_arrays(path, FORMAT, VERSION, meta, arrays)


def read_state(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """`meta` and the arrays, read-only. Raises ValueError for what is no whole state of this version."""
    meta, arrays = read_arrays(path, FORMAT, VERSION, "checkpoint of a mapper")
    try:
        _check_head(meta, arrays.get("keyframes"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return meta, arrays


def images_of(file: Path) -> set[str]:
    """Names of the image files that a state refers to; none where it is damaged."""
    try:
        return _images(read_state(file)[0])
    except ValueError:
        return set()


def _images(meta: Mapping[str, Any]) -> set[str]:
    try:
        return {name for part in meta["mappers"] for name in (*part["images"], *part["between"]) if name}
    except (TypeError, KeyError):
        return set()


def _check_images(file: Path, names: set[str]) -> None:
    """Raises ValueError where any is not there."""
    folder = file.parent / KEYFRAMES
    there = {image.name for image in folder.iterdir()} if folder.is_dir() else set()
    if missing := sorted(map(str, names - there)):
        raise ValueError(
            f"{file} needs {len(names)} images in {folder}, of which {len(missing)} are missing, such as {missing[0]}: "
            f"copy the whole folder {FOLDER} from where the map was made"
        )


def _info(file: Path, before: Sequence[Path]) -> CheckpointInfo:
    """before: the older states, one of which is taken instead where an image that it does not need is damaged."""
    meta, arrays = read_state(file)
    names = _images(meta)
    _check_images(file, names)
    for name in set[str]().union(*(names - images_of(older) for older in before)):
        read_pixels(file.parent / KEYFRAMES, name)
    keyframes = np.sort(arrays["keyframes"])
    return CheckpointInfo(
        file, meta["newest_view"], meta["stream_seconds"], keyframes, meta["splats"], meta["stream_ended"]
    )


def _check_head(meta: dict[str, Any], keyframes: np.ndarray | None) -> None:
    """How far the stream had come: what the launcher reads, and the mapper. Raises ValueError."""
    for name in ("newest_view", "revision", "splats", "refined"):
        value = meta.get(name)
        if type(value) is not int or not -1 <= value < 2**63:
            raise ValueError(f"{name} is {value!r}")
    if keyframes is None or keyframes.dtype != np.int64 or keyframes.ndim != 1:
        raise ValueError("its keyframes are missing")
    seconds = meta.get("stream_seconds")
    if type(seconds) is not float or not math.isfinite(seconds) or type(meta.get("stream_ended")) is not bool:
        raise ValueError("how far the stream had come is not said")
