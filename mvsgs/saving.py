"""A map of a program in the folder that a run would leave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from torch import Tensor, from_numpy

from mvsgs_core.atomic_file import replacing, sync_to_disk
from mvsgs_core.export import keyframe_images
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.kept_map import FOLDER, STREAM, TRACKER, tracker_file
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.files import state_files
from mvsgs_core.mapping.checkpoints.results import cameras_of, write_results
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.resting_images import on_disk
from mvsgs_core.shared_folder import refusal, shared
from mvsgs_core.trajectory import Trajectory
from mvsgs_core.trajectory_file import write_trajectory

CAMERAS, TRANSFORMS = "cameras.json", "transforms.json"
RESULTS = ("map.ply", CAMERAS, TRANSFORMS, "trajectory.txt", keyframe_images.FOLDER, FOLDER)  # what a save leaves


def save_map(
    folder: Path, atlas: Atlas, source: SourceCamera | None, trajectory: Trajectory | None, images: bool,
    came: Mapping[int, Tensor] | None = None, keep_tracker: Callable[[Path], object] | None = None,
) -> int:  # fmt: skip
    """A kept map, and beside it what others read. An earlier map there is replaced, and nothing that anybody else has
    left; whatever is raised, the earlier one can be gone on with, or this one.

    source: the camera that took the stream. trajectory: of all frames, of which those in the map's
    part of the stream are written; None: that of the keyframes is. images: the keyframes', too. came: of keyframes that
    are trained on another image than the one that came, the latter (H, W, 3) uint8, by index. keep_tracker: writes the
    tracker's half of the map to a file; None: there is none.
    Returns how many keyframes have no image that could be written. Raises OSError; ValueError for a folder with the
    report of a run, which would be another map's then, or with files of others that would be replaced, and for the
    root of the file system and the home folder.
    """
    if what := shared(folder):
        raise ValueError(f"{folder}: {refusal(folder, what, 'a map')}")
    if (folder / "report.json").exists():
        raise ValueError(f"{folder}: is the output of a run, with its report; save to another folder")
    earlier = _saved_keyframes(folder)
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    shown = atlas.largest
    if earlier is None:  # first of all, so that what is cut off is known as a save
        write_cameras(folder / CAMERAS, cameras_of(shown.snapshot(), shown.views), source)
    _write_halves(folder, atlas, keep_tracker)
    written = _write_images(folder, shown.views if images else [], came or {})
    _remove_images(folder, set(earlier or []) - written)
    write_results(folder, shown, source=source)
    if not written:  # it would name images that are not there
        (folder / TRANSFORMS).unlink(missing_ok=True)
    if trajectory is not None:
        with replacing(folder / "trajectory.txt") as aside:
            mapped = trajectory.main([view.index for view in shown.views])
            write_trajectory(aside, trajectory.timestamp[mapped], trajectory.world_from_cam[mapped])
    return len(shown.views) - len(written) if images else 0


def _write_halves(folder: Path, atlas: Atlas, keep_tracker: Callable[[Path], object] | None) -> None:
    """The mapper's half beside that of the save before, which goes last. The tracker's is made first, as it needs room,
    and put in its place then, which needs none; until then the save before is the one that is there."""
    writer, before, half = CheckpointWriter(folder, atlas.largest.config), state_files(folder), tracker_file(folder)
    aside = half.with_name(f".{TRACKER}")
    last = half if keep_tracker is None else aside  # is there until the tracker's half is this map's, too
    try:
        if keep_tracker is not None:
            keep_tracker(aside)
        writer.write(atlas.frozen())
        if keep_tracker is None:
            half.unlink(missing_ok=True)
        else:
            aside.replace(half)
    except BaseException:
        if last.exists():
            for file in set(state_files(folder)) - set(before):
                file.unlink()
        aside.unlink(missing_ok=True)
        raise
    sync_to_disk(half.parent)
    writer.keep_newest()


def images_before(folder: Path, atlas: Atlas) -> dict[int, Tensor]:
    """Of the map in `folder`, which `atlas` begins on: images (H, W, 3) uint8 of keyframes that are trained on another
    one, by index; without those that are not there, or find no room on the disk."""
    found, pictures = {}, folder / keyframe_images.FOLDER
    for view in (view for part in atlas.parts.values() for view in part.views if _image(view, {}) is None):
        image = keyframe_images.known_image(pictures, view.index + STREAM)
        if image is not None and image.shape[:2] == view.image_size:
            with suppress(OSError):
                found[view.index] = on_disk(from_numpy(image))
    return found


def _saved_keyframes(folder: Path) -> list[int] | None:
    """Of the map that was saved there; None: none was. Raises ValueError for names of a save's that are others'."""
    there = [name for name in RESULTS if (folder / name).exists()]
    kept = folder / FOLDER
    if not there or (there == [FOLDER] and kept.is_dir() and not any(kept.iterdir())):  # the latter: cut off at once
        return None
    with suppress(OSError, ValueError):
        if kept.is_dir():  # who exports leaves cameras.json, too, and no checkpoint
            return read_cameras(folder / CAMERAS).keyframes.tolist()
    raise ValueError(f"{folder}: {', '.join(there)} is there and was left by no save of a map; save to another folder")


def _write_images(folder: Path, views: list[TrainingView], came: Mapping[int, Tensor]) -> set[int]:
    """The keyframes whose image is there then."""
    written = set()
    for view in views:
        if (image := _image(view, came)) is not None:
            keyframe_images.write_image(folder / keyframe_images.FOLDER, view.index, image.cpu().numpy())
            written.add(view.index)
    return written


def _remove_images(folder: Path, keyframes: set[int]) -> None:
    """Those of an earlier save."""
    for index in keyframes:
        (folder / keyframe_images.FOLDER / keyframe_images.image_name(index)).unlink(missing_ok=True)
    with suppress(OSError):  # there is none, or there are images in it
        (folder / keyframe_images.FOLDER).rmdir()


def _image(view: TrainingView, came: Mapping[int, Tensor]) -> Tensor | None:
    """(H, W, 3) uint8 as it came; None where it was let go, or was of a stream before and is trained on as a rolling
    shutter took it."""
    if view.index in came:
        return came[view.index]
    if not view.has_image or view.size != view.image_size or (view.index < 0 and view.readout_time):
        return None
    return view.image


__all__ = ["images_before", "save_map"]
