"""Writes checkpoints in a thread of its own, so that the stream is held up for a copy of the map and no disk."""

from __future__ import annotations

import contextlib
import errno
import logging
import queue
import threading
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from mvsgs_core.kept_map import FOLDER, TRACKER
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.checkpoint import save
from mvsgs_core.mapping.checkpoints.files import KEYFRAMES, images_of, number_of, state_file, state_files
from mvsgs_core.mapping.checkpoints.images import image_name, write_image
from mvsgs_core.mapping.checkpoints.results import write_results
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import TrainingView

FULL = (errno.ENOSPC, errno.EDQUOT)  # a disk, or what a user may have of it
AHEAD = 8  # keyframes whose images may wait to be written before their checkpoint is
ASIDE = (  # what a killed process left half written, see `atomic_file`
    ".map.*.ply", ".trajectory.*.txt", ".cameras.*.json", ".transforms.*.json", "keyframes/.*.png",
    f"{FOLDER}/.state-*.npz", f"{FOLDER}/.{TRACKER}",
)  # fmt: skip


class CheckpointWriter:
    """One checkpoint after the other into `output`, of which the newest two stay, with map.ply and trajectory.txt.

    What cannot be written is a line in `problems`; the checkpoint before then stays. No method but `write` and
    `keep_newest` raises OSError.
    """

    def __init__(self, output: Path, config: MapperConfig, resumed: Path | None = None) -> None:
        """resumed: the state in `output` that the run goes on from; others there are another run's."""
        self._output, self._config = output, config
        self._number = max((number_of(file) for file in state_files(output)), default=0)
        self._before = resumed  # newest whole state of this run,
        self._images_before: set[str] = set() if resumed is None else images_of(resumed)  # and what it refers to
        self._names: dict[int, tuple[weakref.ref[Tensor], str]] = {}  # by keyframe: its image, and the file of it
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()  # None: no more come
        self._changed = threading.Condition()
        self._pending = 0  # checkpoints that are not done,
        self._left = 0  # and jobs of any kind
        self._thread: threading.Thread | None = None
        self.problems: queue.SimpleQueue[str] = queue.SimpleQueue()
        with contextlib.suppress(OSError):  # now, as nothing is being written
            self._remove_parts()
            if resumed is not None and number_of(resumed) < self._number:
                self.keep_newest()  # newer ones were damaged: their images are to be written anew

    @property
    def busy(self) -> bool:
        return self._pending > 0

    def prepare(self, view: TrainingView) -> None:
        """Writes a new keyframe's image ahead of its checkpoint; not where the disk is behind."""
        if self._jobs.qsize() < AHEAD:
            kept = replace(view)  # should it be let go meanwhile
            self._do(lambda: self._write_image(kept, sync=True))

    def submit(self, atlas: Atlas, *, sync: bool = True, results: bool = True) -> None:
        """Begins to write a frozen atlas, after what is being written. sync: wait for the disk. results: map.ply and
        what lies beside it, too."""
        with self._changed:
            self._pending += 1
        self._do(lambda: self._write(atlas, sync, results))

    def write(self, atlas: Atlas) -> None:
        """Writes a frozen atlas's state now, beside those that are there until `keep_newest`; nothing else is being
        written. Raises OSError."""
        self._write_state(atlas, sync=True)

    def wait(self, seconds: float | None = None) -> bool:
        """Whether all that was begun is done, by then. None: however long it takes."""
        with self._changed:
            return self._changed.wait_for(lambda: self._left == 0, seconds)

    def close(self) -> None:
        """No more is to be written; what was begun is done."""
        if self._thread is not None:
            self._jobs.put(None)

    def keep_newest(self) -> None:
        """Removes all but the newest checkpoint, where one was written; nothing is being written. Raises OSError."""
        if self._before is not None:
            self._remove_others({self._before}, self._images_before)

    def _do(self, job: Callable[[], object]) -> None:
        with self._changed:
            self._left += 1
        self._jobs.put(job)
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="checkpoints", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                with self._telling(f"no checkpoint can be written to {self._output / FOLDER}"):
                    job()
            except Exception as error:  # of the checkpoint only: the map is not lost for it, and nothing is hidden
                logging.exception("checkpoint")
                self.problems.put(f"a checkpoint failed, the run goes on: {type(error).__name__}: {error}")
            finally:
                del job  # with the map that it wrote, for which the next one may be long in coming
                with self._changed:
                    self._left -= 1
                    self._changed.notify_all()

    @contextlib.contextmanager
    def _telling(self, what: str) -> Iterator[None]:
        """Where the disk refuses something, that it could not be done is a problem."""
        try:
            yield
        except OSError as error:
            room = ": make room there" if error.errno in FULL else ""
            self.problems.put(f"{what}: {error.strerror or error}; the run goes on and the last checkpoint stays{room}")

    def _write(self, atlas: Atlas, sync: bool, results: bool) -> None:
        try:
            before, images = self._before, self._images_before
            self._write_state(atlas, sync)
            with self._telling(f"earlier checkpoints cannot be removed from {self._output / FOLDER}"):
                self._remove_others({self._before, before}, self._images_before | images)
            if results:
                with self._telling(f"map.ply and what lies beside it cannot be written to {self._output}"):
                    write_results(self._output, atlas.largest, sync=sync)
        finally:
            with self._changed:
                self._pending -= 1

    def _write_state(self, atlas: Atlas, sync: bool) -> None:
        (self._output / FOLDER / KEYFRAMES).mkdir(parents=True, exist_ok=True)
        known = {
            segment: (
                [self._write_image(view, sync=sync) for view in part.views],
                [self._write_image(view, sync=sync) for view in part.keyframes.between],
            )
            for segment, part in atlas.parts.items()
        }
        file = state_file(self._output, self._number + 1)
        save(atlas, self._config, file, known, sync=sync)
        self._number += 1
        self._before = file
        self._images_before = {name for both in known.values() for names in both for name in names if name}
        present = {view.index for part in atlas.parts.values() for view in part.keyframes.trained}
        self._names = {index: entry for index, entry in self._names.items() if index in present}

    def _write_image(self, view: TrainingView, sync: bool) -> str:
        """Name of a keyframe's image file, which is there then; empty where it was let go."""
        if not view.has_image:
            return ""
        known = self._names.get(view.index)
        if known is not None and known[0]() is view.image:
            return known[1]
        name, folder = image_name(view), self._output / FOLDER / KEYFRAMES
        folder.mkdir(parents=True, exist_ok=True)
        write_image(folder, view, name, sync=sync)
        self._names[view.index] = (weakref.ref(view.image), name)
        return name

    def _remove_others(self, states: set[Path | None], images: set[str]) -> None:
        for file in state_files(self._output):
            if file not in states:
                file.unlink(missing_ok=True)
        for file in (self._output / FOLDER / KEYFRAMES).iterdir():
            if file.name not in images:
                file.unlink(missing_ok=True)

    def _remove_parts(self) -> None:
        """Of a process that was killed while it wrote."""
        for file in [file for pattern in ASIDE for file in self._output.glob(pattern)]:
            file.unlink(missing_ok=True)
