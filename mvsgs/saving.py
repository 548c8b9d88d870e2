"""A map of a program in the folder that a run would leave."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from torch import Tensor

from mvsgs_core.atomic_file import replacing
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.kept_map import FOLDER
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.results import cameras_of, write_results
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.trajectory import Trajectory
from mvsgs_core.trajectory_file import write_trajectory

CAMERAS, TRANSFORMS = "cameras.json", "transforms.json"
RESULTS = ("map.ply", CAMERAS, TRANSFORMS, "trajectory.txt", keyframe_images.FOLDER, FOLDER)  # what a save leaves


def save_map(
    folder: Path, atlas: Atlas, source: SourceCamera | None, trajectory: Trajectory | None, images: bool,
    came: Mapping[int, Tensor] | None = None,
) -> int:  # fmt: skip
    """The mapper's half of a kept map, and beside it what others read. An earlier map there is replaced, and nothing
    that anybody else has left.

    source: the camera that took the stream. trajectory: of all frames, of which those in the map's
    part of the stream are written; None: that of the keyframes is. images: the keyframes', too. came: of keyframes that
    are trained on another image than the one that came, the latter (H, W, 3) uint8, by index.
    Returns how many keyframes have no image that could be written. Raises OSError; ValueError for a folder with the
    report of a run, which would be another map's then, or with files of others that would be replaced.
    """
    if (folder / "report.json").exists():
        raise ValueError(f"{folder}: is the output of a run, with its report; save to another folder")
    earlier = _saved_keyframes(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shown = atlas.largest
    if earlier is None:  # first of all, so that what is cut off is known as a save
        write_cameras(folder / CAMERAS, cameras_of(shown.snapshot(), shown.views), source)
    CheckpointWriter(folder, shown.config).write(atlas.frozen())
    pictures, left_out = folder / keyframe_images.FOLDER, 0
    _remove_images(folder, earlier or [])
    for view in shown.views if images else ():
        image = _image(view, came or {})
        if image is None:
            left_out += 1
        else:
            keyframe_images.write_image(pictures, view.index, image.cpu().numpy())
    write_results(folder, shown, source=source)
    if trajectory is not None:
        with replacing(folder / "trajectory.txt") as aside:
            mapped = trajectory.main([view.index for view in shown.views])
            write_trajectory(aside, trajectory.timestamp[mapped], trajectory.world_from_cam[mapped])
    return left_out


def _saved_keyframes(folder: Path) -> list[int] | None:
    """Of the map that was saved there; None: none was. Raises ValueError for names of a save's that are others'."""
    there = [name for name in RESULTS if (folder / name).exists()]
    if not there:
        return None
    try:
        return read_cameras(folder / CAMERAS).keyframes.tolist()
    except (OSError, ValueError):
        raise ValueError(
            f"{folder}: {', '.join(there)} is there and was left by no save of a map; save to another folder"
        ) from None


def _remove_images(folder: Path, keyframes: list[int]) -> None:
    """Those of an earlier save, with what names them."""
    for index in keyframes:
        (folder / keyframe_images.FOLDER / keyframe_images.image_name(index)).unlink(missing_ok=True)
    with suppress(OSError):  # images of others are there, or none
        (folder / keyframe_images.FOLDER).rmdir()
        (folder / TRANSFORMS).unlink(missing_ok=True)


def _image(view: TrainingView, came: Mapping[int, Tensor]) -> Tensor | None:
    """(H, W, 3) uint8 as it came; None where it was let go, or was of a stream before and is trained on as a rolling
    shutter took it."""
    if view.index in came:
        return came[view.index]
    if not view.has_image or view.size != view.image_size or (view.index < 0 and view.readout_time):
        return None
    return view.image


__all__ = ["save_map"]
