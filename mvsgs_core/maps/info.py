"""What is in a map that a run kept: both of its halves, in words."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from mvsgs_core.kept_map import FOLDER, TRACKER, check_kept_map, tracker_file
from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from mvsgs_core.tracking import known_map


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
        f"rolling shutter {1e3 * known.readout_time:.1f} ms",
        f"light       {_light(known)}",
        f"extent      {_lengths(np.ptp(positions, axis=0))} between keyframes, {depth:.3g} to what they see (median)",
    ]
    streams = sorted({int(keyframe.image.timestamp // 86400) for keyframe in known.keyframes})
    if streams[-1] > 0:  # timestamps of a clock, not of a file's beginning
        days = [time.strftime("%Y-%m-%d", time.gmtime(86400 * day)) for day in (streams[0], streams[-1])]
        lines.append(f"taken       {' to '.join(dict.fromkeys(days))}")
    if len(known.segments) > 1:
        lines.append(f"parts       {len(known.segments)}, which share no frame of reference")
    size = sum(file.stat().st_size for file in (output / FOLDER).rglob("*") if file.is_file())
    return [*lines, f"size        {1e-6 * size:.1f} MB in {output / FOLDER}"]


def _light(known: known_map.KnownMap) -> str:
    if not known.exposures:
        return "steady"
    gains = [exposure[:, :3].sum() / 3.0 for exposure in known.exposures.values()]
    return f"exposures from {min(gains):.2f} to {max(gains):.2f} of the mean"


def _lengths(extent: np.ndarray) -> str:
    return " x ".join(f"{length:.3g}" for length in extent)


__all__ = ["info"]
