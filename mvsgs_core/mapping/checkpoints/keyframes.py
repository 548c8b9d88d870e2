"""The keyframes of a checkpoint as they were seen: what a map can be scored with where its stream is gone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.array_file import Arrays
from mvsgs_core.geometry import twist_scaled
from mvsgs_core.mapping.checkpoints.files import KEYFRAMES, checkpoint_info, read_state
from mvsgs_core.mapping.checkpoints.images import read_image
from mvsgs_core.mapping.checkpoints.state import keyframe_rows


@dataclass(frozen=True)
class KeptKeyframe:
    """A keyframe of a checkpoint."""

    index: int  # of the frame in its stream
    timestamp: float  # seconds
    intrinsics: np.ndarray  # (4,) in pixels of the training image
    world_from_cam: np.ndarray  # (4, 4) float64, the tracker's
    segment: int  # part of the map
    exposure: np.ndarray  # (3, 4) float32, the tracker's; NaN: none is known
    velocity: np.ndarray  # (6,) of the camera, as in `msgs`
    readout_time: float  # seconds of its rolling shutter
    reads_columns: bool  # that it reads columns, not rows
    folder: Path  # of the images
    name: str  # of its image's file; empty where that was let go

    def image(self) -> np.ndarray | None:
        """(H, W, 3) uint8 RGB as it is trained on; None: let go. Raises ValueError for a damaged file."""
        return read_image(self.folder, self.name)[0].numpy() if self.name else None

    def mask(self) -> np.ndarray | None:
        """(H, W) bool, False where a pixel is not trained on; None: all are. Raises ValueError for a damaged file."""
        valid = read_image(self.folder, self.name)[1] if self.name else None
        return None if valid is None else valid.numpy()


def kept_keyframes(output: Path | str) -> list[KeptKeyframe]:
    """Of the newest whole checkpoint in a run's output directory, in the order of the stream.

    Raises ValueError where there is none.
    """
    file = checkpoint_info(output).file
    meta, raw = read_state(file)
    try:
        found = [
            KeptKeyframe(
                row["index"], row["timestamp"], row["intrinsics"], row["world_from_cam"], int(part["segment"]),
                row["measured"], twist_scaled(row["velocity"], float(part["unit"] or 1.0)),
                row["readout_time"], row["reads_columns"], file.parent / KEYFRAMES, row["file"],
            )
            for k, part in enumerate(meta["mappers"])
            for row in keyframe_rows(Arrays(raw).of(f"map{k}").of("views"), part["images"])
        ]  # fmt: skip
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise ValueError(f"{file} is no checkpoint of a mapper: {error!r}") from error
    return sorted(found, key=lambda keyframe: keyframe.index)
