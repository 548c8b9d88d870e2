"""A map of a program in the folder that a run would leave."""

from __future__ import annotations

from pathlib import Path

from mvsgs_core.atomic_file import replacing
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.results import write_results
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.trajectory import Trajectory
from mvsgs_core.trajectory_file import write_trajectory


def save_map(
    folder: Path, atlas: Atlas, source: SourceCamera | None, trajectory: Trajectory | None, images: bool
) -> None:  # fmt: skip
    """The mapper's half of a kept map, and beside it what others read. An earlier map there is replaced.

    source: the camera that took the stream. trajectory: of all frames, of which those in the map's
    part of the stream are written; None: that of the keyframes is.
    Raises OSError; ValueError for a folder with the report of a run, which would be another map's then.
    """
    if (folder / "report.json").exists():
        raise ValueError(f"{folder}: is the output of a run, with its report; save to another folder")
    folder.mkdir(parents=True, exist_ok=True)
    shown = atlas.largest
    CheckpointWriter(folder, shown.config).write(atlas.frozen())
    pictures = folder / keyframe_images.FOLDER
    for file in pictures.glob("*.png"):
        file.unlink()
    for view in shown.views if images else ():
        if view.has_image and view.size == view.image_size:
            keyframe_images.write_image(pictures, view.index, view.image.cpu().numpy())
    write_results(folder, shown, source=source)
    if trajectory is not None:
        with replacing(folder / "trajectory.txt") as aside:
            mapped = trajectory.main([view.index for view in shown.views])
            write_trajectory(aside, trajectory.timestamp[mapped], trajectory.world_from_cam[mapped])


__all__ = ["save_map"]
