"""What a map leaves in the output directory: map.ply, cameras.json and trajectory.txt, each whole at any time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs_core.atomic_file import replacing
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import Cameras, write_cameras
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.export.transforms import write_transforms
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.trajectory_file import write_trajectory

NOT_THERE = "keyframes without an image in keyframes/, left out of transforms.json"


def write_results(output: Path, mapper: OnlineMapper, *, source: SourceCamera | None = None, sync: bool = True) -> int:
    """Replaces them by what the mapper has now; the bytes of map.ply. Raises OSError.

    trajectory.txt: the stream's keyframes' poses as the mapper has them, TUM format; those without a timestamp are left
    out.
    transforms.json, where the keyframes' images are kept: for nerfstudio. source: see `write_cameras`. The map comes
    last: where there is one, there are the others.
    """
    output.mkdir(parents=True, exist_ok=True)
    final = mapper.snapshot()
    seconds = np.array([view.timestamp for view in mapper.views], dtype=np.float64)
    known = np.isfinite(seconds) & (final.keyframes >= 0)
    with replacing(output / "trajectory.txt", sync=sync) as aside:
        write_trajectory(aside, seconds[known], final.world_from_cam[known])
    cameras = cameras_of(final, mapper.views)
    write_cameras(output / "cameras.json", cameras, source)
    if (output / keyframe_images.FOLDER).is_dir():
        there = write_transforms(output / "transforms.json", cameras, output / keyframe_images.FOLDER)
        if 0 < there < len(cameras):
            mapper.log.skip(NOT_THERE, len(cameras) - there)
    write_ply(output / "map.ply", final, sync=sync)
    return (output / "map.ply").stat().st_size


def remove_results(output: Path) -> None:
    """Those of a map that is no more; the map goes first."""
    for name in ("map.ply", "cameras.json", "transforms.json", "trajectory.txt"):
        (output / name).unlink(missing_ok=True)


def cameras_of(final: Snapshot, views: list[TrainingView]) -> Cameras:
    """The cameras of a map's keyframes, at the size of their images as they came; `views` as in the snapshot."""
    count = len(views)
    return Cameras(
        keyframes=final.keyframes,
        timestamps=np.array([view.timestamp for view in views], dtype=np.float64),
        world_from_cam=final.world_from_cam,
        intrinsics=np.array([view.image_intrinsics for view in views], dtype=np.float64).reshape(count, 4),
        sizes=np.array([view.image_size for view in views], dtype=np.int64).reshape(count, 2),
        exposures=final.exposures.astype(np.float64),
        vignetting=None if final.vignetting is None else final.vignetting.astype(np.float64),
    )
