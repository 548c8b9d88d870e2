"""Base of the readers of image files: selection, size, undistortion, and what happens to files that are broken."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.calibration import lens_for_images
from mvsgs_core.datasets.files import UnreadableImageError, read_depth, read_image
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.options import FileOptions


@dataclass(frozen=True)
class Record:
    """A frame before it is read."""

    timestamp: float  # seconds
    image: Path
    lens: Lens
    world_from_cam: np.ndarray | None = None  # (4, 4) float64
    depth: Path | None = None


@dataclass(frozen=True)
class DepthFormat:
    """How integer depth maps count."""

    per_unit: float  # counts per unit of the poses
    invalid: tuple[int, ...] = (0,)  # counts that mean "unknown"


class Notices(list[str]):
    """Warnings, some of them counted: a repeated one stays one line, which says how often and names the first."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: dict[str, tuple[int, int, str]] = {}  # text -> line, times, first example

    def tally(self, text: str, example: str) -> None:
        line, times, first = self._lines.get(text, (len(self), 0, example))
        self._lines[text] = line, times + 1, first
        message = f"{text}: {times + 1} (first: {first})"
        if times:
            self[line] = message
        else:
            self.append(message)

    def truncate(self, length: int) -> None:
        """Back to the first `length` lines, for a second pass over the same files."""
        del self[length:]
        self._lines = {text: entry for text, entry in self._lines.items() if entry[0] < length}


def same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Sizes of one aspect ratio, to a percent (a scaled copy is rounded to whole pixels)."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= 0.01 * a[1] * b[0]


@dataclass(kw_only=True, eq=False)
class FileReader(FileOptions):
    """Base of the readers of files. Raises ValueError for options that make no sense."""

    # pixels to cut off after undistortion; null: zoom to hide the border that it leaves
    crop: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._framing = Framing(self.size, self.crop)
        self.warnings: list[str] = Notices()
        self._notices: Notices = self.warnings  # the same list, with its counting


@dataclass(frozen=True)
class Found:
    """What a reader of image files finds: all frames of the original sequence, in order."""

    records: Sequence[Record]
    depth_format: DepthFormat | None = None  # None: there are no depth maps
    turn_upright: bool = True  # whether the calibration is for the image as EXIF says it should be shown


@dataclass(kw_only=True, eq=False)
class ImageSequence(FileReader, ABC):
    """Frames in files, read when asked for. A file that can't be read is left out with a warning, and it goes on.

    Raises FileNotFoundError and ValueError, which say what was expected, ValueError where nothing is selected too, and
    BadFileError while iterating where not one image can be read.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        found = self._find()
        self.records = list(found.records)[self.wanted]
        if not self.records:
            count = len(found.records)
            raise ValueError(f"no frame left: the sequence has {count}, wanted from {self.start} to {self.stop}")
        self._depth_format, self._turn_upright = found.depth_format, found.turn_upright
        self._opening_warnings = len(self.warnings)

    @property
    def lens(self) -> Lens:
        """The first frame's, at the size that its calibration is for."""
        return self.records[0].lens

    @abstractmethod
    def _find(self) -> Found:
        """What there is; warnings go to `self.warnings`."""

    def _lens(self, images: Sequence[Path], published: Lens) -> Lens:
        """The lens that was given, else the `published` one."""
        return published if self.intrinsics is None else self._given_lens(images, self.intrinsics)

    def _given_lens(self, images: Sequence[Path], intrinsics: Sequence[float] | str) -> Lens:
        lens, notes = lens_for_images(intrinsics, self.distortion, images)
        self.warnings += notes
        return lens

    def __len__(self) -> int:
        """Frames selected; those that turn out unreadable are not delivered."""
        return len(self.records)

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)
        index = 0
        first: tuple[int, int] | None = None  # size on disk of the first image
        for record in self.records:
            try:
                image = read_image(record.image, turn_upright=self._turn_upright)
            except UnreadableImageError as error:
                self._notices.tally("images left out because they could not be read", str(error))
                continue
            item = self._item(index, record, image, first)
            if item is not None:
                first = first or (image.shape[0], image.shape[1])
                index += 1
                yield item
        if index == 0:
            raise BadFileError("no image could be read: " + "; ".join(self._notices))

    def _item(self, index: int, record: Record, image: np.ndarray, first: tuple[int, int] | None) -> Item | None:
        native = image.shape[0], image.shape[1]
        if not same_shape(native, record.lens.size):
            what = "images left out because their calibration is for another aspect ratio"
            self._notices.tally(what, f"{record.image.name}, {_text(native)} for {_text(record.lens.size)}")
            return None
        if first is not None and native != first:
            example = f"{record.image.name}, {_text(native)} after {_text(first)}"
            if not same_shape(native, first):
                self._notices.tally("images left out because they have another aspect ratio than the first", example)
                return None
            self._notices.tally("images scaled to the size of the first", example)
        if first is None:
            self.warnings += self._framing.notice(native)
        size = self._framing.size_of(first or native)
        lens = record.lens.at(native)
        try:
            framed, intrinsics = self._framing.image(image, lens, size)
        except ValueError as error:
            what = "images left out because their distortion cannot be undone"
            self._notices.tally(what, f"{record.image.name}, {error}")
            return None
        depth = self._depth(record, native)
        if depth is not None:
            depth = self._framing.depth(depth, lens, size)
        pose, exposure = record.world_from_cam, self._exposure(record)
        return Item(index, record.timestamp, framed, intrinsics, pose, depth, lens.guessed, exposure)

    def _exposure(self, record: Record) -> float:
        """As in `Item`: of most sets nothing is known of it."""
        return 0.0

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        """The depth map (h, w) as the color camera would see it: of most sets it is already."""
        return depth

    def _depth(self, record: Record, native: tuple[int, int]) -> np.ndarray | None:
        """Depth map as it is on disk, None where there is none."""
        if self._depth_format is None:
            return None
        if record.depth is None or not record.depth.exists():
            self._notices.tally("frames without a depth map, where depth is not scored", record.image.name)
            return None
        try:
            depth = read_depth(record.depth, self._depth_format.per_unit, self._depth_format.invalid)
        except UnreadableImageError as error:
            self._notices.tally("depth maps that could not be read, so that depth is not scored there", str(error))
            return None
        depth = self._registered(depth)
        if not same_shape((depth.shape[0], depth.shape[1]), native):
            self._notices.tally(
                "depth maps left out because they have another aspect ratio than their image", record.image.name
            )
            return None
        return depth


def _text(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"
