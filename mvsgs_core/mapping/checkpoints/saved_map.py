"""A map that is saved while the stream goes on: a copy is made at once, and written by a thread."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from mvsgs_core.kept_map import FOLDER, NOTHING_MAPPED, drop_tracker_half
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.files import KEYFRAMES, state_files
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
        self._copy, self._config, self._folder = atlas.frozen(), config, folder
        self.write()

    def write(self) -> None:
        """Begins to write the copy, another time where there was no room."""
        self._writer, self._problem = CheckpointWriter(self._folder, self._config), ""
        self._writer.submit(self._copy)
        self._writer.close()

    def wait(self, seconds: float | None = None) -> bool:
        """Whether it is done by then, be it with a problem. None: however long it takes."""
        return self._writer.wait(seconds)

    @property
    def done(self) -> bool:
        return self.wait(0.0)

    @property
    def problem(self) -> str:
        """Why it could not be written; empty where it was. To be asked once it is done."""
        if not self._writer.problems.empty():
            self._problem = self._writer.problems.get()
        return self._problem

    def drop(self) -> None:
        """It could not be written: no half of a map stays."""
        with contextlib.suppress(OSError):
            if not state_files(self._folder):
                shutil.rmtree(self._folder / FOLDER / KEYFRAMES, ignore_errors=True)
                drop_tracker_half(self._folder)


__all__ = ["SavedMap"]
