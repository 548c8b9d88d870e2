"""An atlas as a checkpoint: written to a folder and read back, every value checked. See `files`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.array_file import Arrays
from mvsgs_core.atomic_file import replacing
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.between import FramesBetween
from mvsgs_core.mapping.checkpoints.files import KEYFRAMES, nothing_there, read_state, state_files, write_state
from mvsgs_core.mapping.checkpoints.images import read_image
from mvsgs_core.mapping.checkpoints.state import Corrections, pack, photometry_arrays, photometry_of, unpack, whole
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.stats import Stats

# What the state's arrays depend on; everything else may be another one when a run goes on, and then is said.
FIXED = ("sh_degree", "max_pixels", "training.kernel", "training.antialiased")
OF_THE_MACHINE = ("device", "threads", "training.backend")
LOGGED = ("counts", "skipped", "seconds", "warnings")


def save(
    atlas: Atlas, config: MapperConfig, file: Path, names: dict[int, tuple[list[str], list[str]]], *, sync: bool
) -> None:
    """Writes a frozen atlas's state. config: of its mappers, with their device; names: image files by segment, of
    keyframes and of the frames between them.

    Raises OSError.
    """
    log, corrections, photometry = atlas.current.log, atlas.current.corrections, atlas.current.photometry
    index = sorted(corrections)
    poses = np.array([corrections[k][0] for k in index], dtype=np.float64).reshape(-1, 4, 4)
    arrays: dict[str, np.ndarray] = {
        "keyframes": np.array([view.index for part in atlas.parts.values() for view in part.views], dtype=np.int64),
        "segment_of": np.array(sorted(atlas.segment_of.items()), dtype=np.int64).reshape(-1, 2),
        "between": np.array(sorted(atlas.between.taken), dtype=np.int64),
        "corrections/index": np.array(index, dtype=np.int64),
        "corrections/world_from_cam": poses,
        "corrections/scale": np.array([corrections[k][1] for k in index], dtype=np.float64),
    }
    arrays |= {f"photometry/{name}": value for name, value in photometry_arrays(photometry).items()}
    mappers: list[dict[str, Any]] = []
    for segment, part in atlas.parts.items():
        head, own = pack(part, f"map{len(mappers)}", *names[segment])
        mappers.append({"segment": segment, "current": part is atlas.current, **head})
        arrays |= own
    meta = {
        "config": described(config), "newest_view": atlas.newest_view, "stream_seconds": atlas.stream_seconds,
        "revision": atlas.revision, "stream_ended": atlas.stream_ended, "refined": atlas.refined,
        "splats": len(atlas.largest.state), "mappers": mappers,
        "log": {name: getattr(log, name) for name in LOGGED},
    }  # fmt: skip
    with replacing(file, sync=sync) as aside:
        write_state(aside, meta, arrays)


def load(output: Path, config: MapperConfig, log: Stats, *, counted: bool = True) -> tuple[Atlas, Path]:
    """The atlas of the newest whole checkpoint in a run's output directory, and its file.

    `log` gets what that run had counted, and that it was resumed, where it is wanted; and warnings of what was wrong
    with newer checkpoints and of what of `config` is not as it was. Raises ValueError where there is none, or `config`
    does not fit.
    """
    problems: list[str] = []
    for file in state_files(output):
        try:
            atlas = _load(file, config, log, counted)
        except ValueError as error:
            problems.append(f"{file}: {error}")
            continue
        for problem in problems:
            log.warn(f"an older checkpoint was taken: {problem}")
        return atlas, file
    raise ValueError("; ".join(problems) or nothing_there(output))


def described(config: Any, kind: type[Any] = MapperConfig, prefix: str = "") -> dict[str, str]:
    """All parameters that `kind` declares as text, by name with dots."""
    found: dict[str, str] = {}
    for entry in fields(kind):
        value, name = getattr(config, entry.name), prefix + entry.name
        found |= described(value, type(value), f"{name}.") if is_dataclass(value) else {name: repr(value)}
    return found


def _load(file: Path, config: MapperConfig, log: Stats, counted: bool) -> Atlas:
    meta, raw = read_state(file)
    arrays, parts = Arrays(raw), meta.get("mappers")
    differing = list(_differences(meta.get("config"), config))
    logged = _logged(meta.get("log"))
    corrections, photometry = _corrections(arrays.of("corrections")), photometry_of(arrays.of("photometry"))
    if not isinstance(parts, list) or not parts or not all(isinstance(part, dict) for part in parts):
        raise ValueError("it has no mappers")
    segments = [part.get("segment") for part in parts]
    chosen = [k for k, part in enumerate(parts) if part.get("current") is True]
    if (
        not all(type(s) is int and abs(s) < 2**31 for s in segments)
        or len(set(segments)) < len(segments)
        or len(chosen) != 1
    ):
        raise ValueError("its segments are not clear")
    image = partial(read_image, file.parent / KEYFRAMES)
    mappers = [
        unpack(part, arrays.of(f"map{k}"), config, log, corrections, photometry, image) for k, part in enumerate(parts)
    ]
    pairs = arrays.take("segment_of", np.int64, (None, 2))
    atlas = Atlas(
        mappers[chosen[0]], dict(zip(segments, mappers)), dict(pairs.tolist()), meta["newest_view"],
        meta["stream_seconds"], meta["revision"], meta["stream_ended"],
        FramesBetween(taken=set(arrays.take("between", np.int64, (None,)).tolist())), whole(meta["refined"], "refined"),
    )  # fmt: skip
    if counted:
        log.include(logged)
        log.values["resumed"] = str(file)
    if differing:
        log.warn(f"the run goes on with other parameters than it had: {', '.join(differing)}")
    return atlas


def _differences(saved: Any, config: MapperConfig) -> Iterator[str]:
    if not isinstance(saved, dict):
        raise ValueError("its configuration is missing")
    for name, value in described(config).items():
        before = saved.get(name)
        if before == value or name in OF_THE_MACHINE:
            continue
        if name in FIXED:
            raise ValueError(f"{name} was {before} in that run and is {value} now: resume with that run's parameters")
        yield f"{name}={value} (was {before})"


def _logged(saved: Any) -> Stats:
    if not isinstance(saved, dict):
        raise ValueError("its log is missing")
    log = Stats()
    for name, into in (("counts", log.counts), ("skipped", log.skipped), ("seconds", log.seconds)):
        values = saved.get(name)
        if not isinstance(values, dict) or not all(type(value) in (int, float) for value in values.values()):
            raise ValueError(f"its log has no {name}")
        into |= values
    warnings = saved.get("warnings")
    if not isinstance(warnings, list) or not all(isinstance(text, str) for text in warnings):
        raise ValueError("its log has no warnings")
    log.warnings.include(warnings)
    return log


def _corrections(arrays: Arrays) -> Corrections:
    index = arrays.take("index", np.int64, (None,))
    poses = arrays.take("world_from_cam", np.float64, (len(index), 4, 4))
    scale = arrays.take("scale", np.float64, (len(index),))
    if (scale <= 0).any():
        raise ValueError("a correction's scale is not above 0")
    return {int(k): (pose.copy(), float(s)) for k, pose, s in zip(index, poses, scale)}
