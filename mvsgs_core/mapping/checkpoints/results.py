"""What a map leaves in the output directory: map.ply, cameras.json and trajectory.txt, each whole at any time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs_core.atomic_file import replacing
from mvsgs_core.evaluation.trajectory import write_tum
from mvsgs_core.splats.cameras import cameras_of, write_cameras
from mvsgs_core.splats.export_ply import write_ply
from mvsgs_core.splats.mapper import OnlineMapper


def write_results(output: Path, mapper: OnlineMapper, *, sync: bool = True) -> int:
    """Replaces them by what the mapper has now; the bytes of map.ply. Raises OSError.

    trajectory.txt: the keyframes' poses as the mapper has them, TUM format; those without a timestamp are left out.
    The map comes last: where there is one, there are the others.
    """
    output.mkdir(parents=True, exist_ok=True)
    final = mapper.snapshot()
    seconds = np.array([view.timestamp for view in mapper.views], dtype=np.float64)
    known = np.isfinite(seconds)
    with replacing(output / "trajectory.txt", sync=sync) as aside:
        write_tum(aside, seconds[known], final.world_from_cam[known])
    write_cameras(output / "cameras.json", cameras_of(final, mapper.views))
    with replacing(output / "map.ply", sync=sync) as aside:
        write_ply(aside, final)
        return aside.stat().st_size
