"""The frames that a run's map is scored on: chosen while the stream goes on, when nobody knows how long it will be.

Held-out frames, all others and keyframes are thinned out each by themselves (`thinning`), so that there are enough of
each kind; the last frames of the stream are always there, for its end is where maps fail. A keyframe's image comes with
its depth, as it was mapped: it is scored on the stream's own where that was kept and a Trajectory says what camera took
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.evaluation.thinning import Thinned
from mvsgs_core.held_out import is_held_out

ENDING = 5  # last frames of the stream, all of them there
MIN_KEPT = 400  # frames of each kind that are kept at least, so that short streams are whole


@dataclass(frozen=True)
class Photograph:
    """An image that a render can be compared with."""

    image: Callable[[], np.ndarray]  # (H, W, 3) uint8, read when needed
    intrinsics: np.ndarray  # (4,)
    as_mapped: bool  # from a keyframe: final intrinsics, and no rolling shutter any more
    mask: Callable[[], np.ndarray | None]  # (H, W) bool, the pixels that count; None: all


@dataclass(frozen=True)
class _Frame:
    image: np.ndarray
    intrinsics: np.ndarray
    depth: np.ndarray | None
    mask: np.ndarray | None

    def arrays(self) -> dict[str, np.ndarray]:
        given = {"image": self.image, "depth": self.depth, "mask": self.mask}
        return {name: array for name, array in given.items() if array is not None}


@dataclass(frozen=True)
class _Mapped:
    intrinsics: np.ndarray
    scale: float


class Frames:
    """Images and depth maps to score, on disk but for the last few; `max_frames` 0: none."""

    def __init__(self, folder: Path | None, max_frames: int, max_bytes: float) -> None:
        """folder: where they wait; max_frames: that will be scored; max_bytes: on disk, for all of them."""
        kept = max(2 * max_frames, MIN_KEPT)
        self._none = max_frames == 0
        self._max_bytes = max_bytes
        self._streamed: dict[bool, Thinned[np.ndarray]] = {
            held_out: Thinned(folder, kept, max_bytes / 3) for held_out in (True, False)
        }
        self._mapped: Thinned[_Mapped] = Thinned(folder, kept, max_bytes / 3)
        self._ending: dict[int, _Frame] = {}  # by index, in the order in which they came

    def add(
        self, index: int, image: np.ndarray, intrinsics: np.ndarray, depth: np.ndarray | None,
        mask: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """A frame of the stream; its true depth where it is known. The last few are held as they are.

        mask: (H, W) bool, the pixels that count; None: all.
        """
        if self._none:
            return
        depth = None if depth is None else depth.astype(np.float32, copy=False)
        self._ending.pop(index, None)  # one that comes again replaces the one before
        self._ending[index] = _Frame(image, intrinsics, depth, mask)
        if len(self._ending) > ENDING:
            index = next(iter(self._ending))
            past = self._ending.pop(index)
            self._streamed[is_held_out(index)].add(index, past.intrinsics, past.arrays())

    def add_keyframe(
        self, index: int, image: np.ndarray, intrinsics: np.ndarray, depth: np.ndarray, scale: float,
        mask: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """A keyframe as it was mapped, with its filtered depth at the map's scale `scale`; a later one replaces it."""
        if not self._none:
            arrays = {"image": image, "depth": depth} | ({} if mask is None else {"mask": mask})
            self._mapped.add(index, _Mapped(intrinsics, scale), arrays)

    def photographs(self, *, mapped: bool = False) -> dict[int, Photograph]:
        """All that can be scored, by index. mapped: of a keyframe the image that it was mapped with goes before the
        stream's own."""
        of_keyframes = {
            index: Photograph(
                partial(self._read_mapped, index), note.intrinsics, True, partial(self._mapped.get, index, "mask")
            )
            for index, note in self._mapped.notes.items()
        }
        notes = {index: note for kept in self._streamed.values() for index, note in kept.notes.items()}
        notes |= {index: frame.intrinsics for index, frame in self._ending.items()}
        streamed = {
            index: Photograph(partial(self._read, index), intrinsics, False, partial(self._mask, index))
            for index, intrinsics in notes.items()
        }
        return streamed | of_keyframes if mapped else of_keyframes | streamed

    def true_depth(self, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """(H, W) float32, 0 unknown, as the frame came, and its intrinsics (4,); None where it is not known."""
        streamed = self._streamed[is_held_out(index)]
        if index in self._ending:
            depth, intrinsics = self._ending[index].depth, self._ending[index].intrinsics
        elif (depth := streamed.get(index, "depth")) is not None:
            intrinsics = streamed.notes[index]
        return None if depth is None else (depth, intrinsics)

    def mapped_intrinsics(self, index: int) -> np.ndarray:
        """(4,) of a keyframe as it was mapped. Raises KeyError for one whose depth is not there."""
        return self._mapped.notes[index].intrinsics

    def filtered_depths(self) -> Iterator[tuple[int, float]]:
        """Index and scale of the keyframes whose depth is there."""
        return ((index, mapped.scale) for index, mapped in sorted(self._mapped.notes.items()))

    def filtered_depth(self, index: int) -> np.ndarray | None:
        """(h, w) float32, 0 where filtered out."""
        return self._mapped.get(index, "depth")

    @property
    def size(self) -> int:
        """On disk, in bytes."""
        return sum(kept.size for kept in self._kinds().values())

    def notes(self) -> list[str]:
        """What a bound or a full disk has left out."""
        found = []
        for name, kept in self._kinds().items():
            if kept.too_large:
                found.append(
                    f"evaluator.max_bytes={self._max_bytes:.3g} was reached: {len(kept.notes)} of {kept.seen} {name} "
                    "could be kept to be scored"
                )
            if kept.lost:
                found.append(f"{kept.lost} {name} could not be kept to be scored: {kept.error}")
        return found

    def close(self) -> None:
        """Gives the room on disk back."""
        for kept in self._kinds().values():
            kept.close()

    def _kinds(self) -> dict[str, Thinned[Any]]:
        held_out, others = self._streamed[True], self._streamed[False]
        return {"held-out frames": held_out, "other frames": others, "keyframes": self._mapped}

    def _mask(self, index: int) -> np.ndarray | None:
        """Of the image that `_read` gives."""
        if index in self._ending:
            return self._ending[index].mask
        return self._streamed[is_held_out(index)].get(index, "mask")

    def _read(self, index: int) -> np.ndarray:
        if index in self._ending:
            return self._ending[index].image
        return _kept(self._streamed[is_held_out(index)], index)

    def _read_mapped(self, index: int) -> np.ndarray:
        return _kept(self._mapped, index)


def _kept(frames: Thinned[Any], index: int) -> np.ndarray:
    image = frames.get(index, "image")
    if image is None:
        raise KeyError(f"the image of frame {index} was not kept")
    return image
