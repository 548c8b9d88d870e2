"""A map that is saved while the stream goes on: a copy is made at once, and written by a thread."""

from __future__ import annotations

from pathlib import Path

from mvsgs_core.kept_map import NOTHING_MAPPED, drop_tracker_half
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.config import MapperConfig


class SavedMap:
    """The mapper's half of a map, for another run to begin on; the tracker's is there already."""

    def __init__(self, atlas: Atlas, config: MapperConfig, folder: Path) -> None:
        """Raises ValueError where nothing is mapped: then the folder is as it was before the tracker's half came."""
        splats = len(atlas.largest.state)
        if not splats:
            drop_tracker_half(folder)
            raise ValueError(NOTHING_MAPPED)
        self.what = f"{folder}: {splats} splats, {len(atlas.largest.views)} keyframes"
        self._writer = CheckpointWriter(folder, config)
        self._writer.submit(atlas.frozen())
        self._writer.close()

    def wait(self) -> None:
        self._writer.wait()

    @property
    def done(self) -> bool:
        return not self._writer.busy

    @property
    def problem(self) -> str:
        """Why it could not be written; empty where it was. To be asked once it is done."""
        return "" if self._writer.problems.empty() else self._writer.problems.get()


__all__ = ["SavedMap"]
