"""When checkpoints are made, and how little of the mapper's time they may take."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mvsgs_core.export.source_camera import SourceCamera
from mvsgs_core.kept_map import FOLDER
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.results import remove_results, write_results
from mvsgs_core.mapping.checkpoints.writer import FULL, CheckpointWriter
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.stats import Stats

MAX_FRACTION = 0.02  # of the mapper's time, at most, that copying the map for checkpoints holds it up
PATIENCE, BETWEEN = 60.0, 1.0  # seconds that a full disk is waited for at the end, and between two attempts
LAST = 2.5  # seconds for the last checkpoint of a run that ends early


class Checkpointing:
    """Saves an atlas every `period` seconds of the stream or of the clock, and as soon as there is a map.

    Less often where that would take more than `MAX_FRACTION` of the time, or the disk is still writing the last one; a
    map that stays as it is, once.
    """

    def __init__(
        self, output: Path, period: float, atlas: Atlas, resumed: Path | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        """output: the run's directory. period: 0: no checkpoints. resumed: the state that the run goes on from."""
        self._output, self._period, self._clock = output, period, clock
        own = resumed if resumed is not None and resumed.parent.parent == output else None
        self._writer = CheckpointWriter(output, atlas.current.config, own)
        self._began = self._saved_at = clock()
        self._saved_stream = atlas.stream_seconds
        self._never = resumed is None  # saved
        self._saved: tuple[object, ...] = ()  # what changes with the map, as it was then
        self._held = self._last = 0.0  # seconds that copying took: all, the last one

    def keep(self, atlas: Atlas) -> None:
        """Saves if it is time to. Cheap where it is not: to be called after every view, slice and iteration."""
        log = atlas.current.log
        self._pass_problems_on(log)
        if not self._due(atlas):
            return
        start = self._clock()
        with log.time("checkpoint"):
            log.count("checkpoints")
            self._writer.submit(atlas.frozen())
        self._saved_at, self._saved_stream, self._never = self._clock(), atlas.stream_seconds, False
        self._saved = _mark(atlas)
        self._last = self._saved_at - start
        self._held += self._last

    def added(self, view: TrainingView) -> None:
        """A keyframe's images go to the disk at once: so the last checkpoint of a run that ends early is quick."""
        if self._period > 0:
            self._writer.prepare(view)

    def last(self, atlas: Atlas) -> None:
        """What there is, for a run that ends early: within `LAST` seconds, or the checkpoint before stays."""
        log = atlas.current.log
        if not len(atlas.largest.state):
            return
        try:
            if self._period > 0:
                self._writer.submit(atlas.frozen(), sync=False)
                if not self._writer.wait(LAST):
                    log.refuse("checkpoints", 1, "there was no time for a last checkpoint: the one before stays")
            else:
                write_results(self._output, atlas.largest, sync=False)
        except (OSError, ValueError) as error:
            log.refuse("checkpoints", 1, f"no last checkpoint: {error}")
        self._pass_problems_on(log)

    def finish(
        self, atlas: Atlas, source: SourceCamera | None = None, rest: Callable[[], object] = lambda: None
    ) -> int:
        """The finished map: its files are whole and on the disk then; the bytes of map.ply.

        A disk that is full is waited for, `PATIENCE` seconds; then the map goes to a folder for temporary files.
        source: the camera that took the stream. rest: called while it waits. Raises OSError, which says where the map
        is.
        """
        self._writer.wait()
        log = atlas.current.log
        self._pass_problems_on(log)
        until = self._clock() + PATIENCE
        while True:
            try:
                return write_results(self._output, atlas.current, source=source)
            except OSError as error:
                if error.errno not in FULL or self._clock() >= until:
                    raise OSError(self._elsewhere(atlas, source, error)) from error
                log.warn(f"the finished map finds no room in {self._output}: {error.strerror}; make room there")
            rest()
            time.sleep(BETWEEN)

    def _elsewhere(self, atlas: Atlas, source: SourceCamera | None, error: OSError) -> str:
        """Writes the finished map to a folder for temporary files; what to say."""
        said = f"the finished map cannot be written to {self._output}: {error.strerror or error}"
        folder: Path | None = None
        try:
            folder = Path(tempfile.mkdtemp(prefix="mvsgs-map-"))
            write_results(folder, atlas.current, source=source)
        except OSError as other:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)
            return f"{said}; nor to a folder for temporary files: {other.strerror or other}"
        return f"{said}; it is in {folder}"

    def close(self, atlas: Atlas, *, keep: bool) -> None:
        """After `finish`. keep: the map's checkpoint is made too, and stays alone; else the last one stays, for a run
        whose report is still to be made. Of a map without splats nothing stays."""
        mapped = len(atlas.largest.state) > 0
        if keep and mapped:
            self._writer.submit(atlas.frozen(), results=False)  # they are there, with the camera that took the stream
        self._writer.wait()
        if keep and mapped:
            try:
                self._writer.keep_newest()
            except OSError as error:  # the map is there, and a checkpoint more than needs to be
                why = error.strerror or str(error)
                atlas.current.log.warn(f"earlier checkpoints cannot be removed from {self._output / FOLDER}: {why}")
        self._pass_problems_on(atlas.current.log)
        if not mapped:
            shutil.rmtree(self._output / FOLDER, ignore_errors=True)
            remove_results(self._output)

    def _due(self, atlas: Atlas) -> bool:
        if self._period <= 0 or self._writer.busy or not any(len(part.state) for part in atlas.parts.values()):
            return False
        now = self._clock()
        if self._never:
            return True
        if self._held + self._last > MAX_FRACTION * (now - self._began):
            return False
        passed = max(now - self._saved_at, abs(atlas.stream_seconds - self._saved_stream))
        return passed >= self._period and _mark(atlas) != self._saved

    def _pass_problems_on(self, log: Stats) -> None:
        while not self._writer.problems.empty():
            log.refuse("checkpoints", 1, self._writer.problems.get())
            self._saved = ()  # it is to be saved still


def _mark(atlas: Atlas) -> tuple[object, ...]:
    """Another one wherever the map is another one."""
    parts = [(part.iterations, len(part.state), len(part.keyframes.trained)) for part in atlas.parts.values()]
    return atlas.newest_view, atlas.revision, atlas.stream_ended, atlas.refined, *parts
