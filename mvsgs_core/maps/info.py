"""`python -m mvsgs_core.maps.info DIR`: what is in the map that a run with keep_map=true left in its output."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvsgs_core.camera import told_readout_time
from mvsgs_core.kept_map import FOLDER, TRACKER, check_kept_map, tracker_file
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.maps.unfinished import what_is_missing
from mvsgs_core.tracking import known_map

CLOCK = (1e9, 2.0**31)  # s that are a clock's, 2001 to 2038: others count from a file's beginning or in another unit


def main(words: Sequence[str] | None = None, prog: str | None = None) -> int:
    """Prints it; the exit code, 2 where there is no map."""
    parser = argparse.ArgumentParser(prog, description="What is in the map that a run with keep_map=true left.")
    parser.add_argument("folder", type=Path, help="output directory of the run")
    try:
        print("\n".join(info(parser.parse_args(words).folder)))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def info(output: Path) -> list[str]:
    """Lines about the map in a run's output directory. Raises ValueError, saying what is wrong, where there is none."""
    check_kept_map(output)
    splats, known = checkpoint_info(output), known_map.load(tracker_file(output))
    height, width = known.size
    fx, fy, cx, cy = known.intrinsics
    positions = np.stack([np.linalg.inv(k.cam_from_world)[:3, 3] for k in known.keyframes])
    depth = float(np.median([keyframe.median_depth for keyframe in known.keyframes]))
    lines = [
        f"splats      {splats.splats}, trained on {len(splats.keyframes)} keyframes ({splats.file.name})",
        f"keyframes   {len(known.keyframes)} of the tracker, {len(known.edges)} matched pairs ({TRACKER})",
        f"camera      {width}x{height} pixels as tracked, intrinsics [{fx:.1f}, {fy:.1f}, {cx:.1f}, {cy:.1f}], "
        f"rolling shutter {told_readout_time(known.readout_time, reads_columns=known.reads_columns)}",
        f"light       {_light(known)}",
        f"extent      {_lengths(np.ptp(positions, axis=0))} between keyframes, {depth:.3g} to what they see (median)",
    ]
    if days := days_of([keyframe.image.timestamp for keyframe in known.keyframes]):
        lines.append(f"taken       {days}")
    if len(known.segments) > 1:
        lines.append(f"parts       {len(known.segments)}, which share no frame of reference")
    if missing := what_is_missing(output):
        lines.append(f"unfinished  {missing}")
    size = sum(file.stat().st_size for file in (output / FOLDER).rglob("*") if file.is_file())
    return [*lines, f"size        {1e-6 * size:.1f} MB in {output / FOLDER}"]


def days_of(timestamps: Sequence[float]) -> str:
    """The first and the last day of those that are of a clock; empty where none is."""
    known = [stamp for stamp in timestamps if CLOCK[0] <= stamp < CLOCK[1]]
    ends = (min(known), max(known)) if known else ()
    return " to ".join(dict.fromkeys(time.strftime("%Y-%m-%d", time.gmtime(stamp)) for stamp in ends))


def _light(known: known_map.KnownMap) -> str:
    if not known.exposures:
        return "steady"
    gains = [exposure[:, :3].sum() / 3.0 for exposure in known.exposures.values()]
    return f"exposures from {min(gains):.2f} to {max(gains):.2f} of the mean"


def _lengths(extent: np.ndarray) -> str:
    return " x ".join(f"{length:.3g}" for length in extent)


__all__ = ["days_of", "info", "main"]

if __name__ == "__main__":
    sys.exit(main())
