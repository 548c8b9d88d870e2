"""Base of the readers of image files: selection, size, undistortion, and what happens to files that are broken."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core.camera import fit_size, resize_image, scale_intrinsics
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.files import UnreadableImageError, read_depth, read_image
from mvsgs_core.datasets.lens import Lens, Undistortion

Size = tuple[int, int] | Sequence[int] | int | None


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
        message = f"{times + 1} {text} (first: {first})"
        if times:
            self[line] = message
        else:
            self.append(message)

    def truncate(self, length: int) -> None:
        """Back to the first `length` lines, for a second pass over the same files."""
        del self[length:]
        self._lines = {text: entry for text, entry in self._lines.items() if entry[0] < length}


def selection(start: int, stop: int | None, stride: int) -> slice:
    """Which frames of the original sequence are wanted; raises ValueError for a bad one."""
    if start < 0 or stride < 1 or (stop is not None and stop <= start):
        raise ValueError(f"start >= 0, stop > start (or null) and stride >= 1 wanted, got {start}, {stop}, {stride}")
    return slice(start, stop, stride)


def target_size(size: Size, native: tuple[int, int]) -> tuple[int, int]:
    """(height, width) to deliver: `size` itself, about `size` pixels at the same aspect if it is one number, native."""
    if size is None:
        return native
    if isinstance(size, int):
        if size < 64:
            raise ValueError(f"size as one number is a count of pixels, at least 64; got {size}")
        return fit_size(*native, area=size)
    if len(size) != 2 or any(side < 8 for side in size):
        raise ValueError(f"size is [height, width] of at least 8 pixels each, a count of pixels or null; got {size}")
    return int(size[0]), int(size[1])


def resize_depth(depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth map at (height, width): the nearest sample, taken at pixel centers, never an average."""
    if depth.shape == size:
        return depth
    return np.asarray(cv2.resize(depth, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT))


def same_shape(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Sizes of one aspect ratio, to a percent (a scaled copy is rounded to whole pixels)."""
    return abs(a[0] * b[1] - a[1] * b[0]) <= 0.01 * a[1] * b[0]


class ImageSequence:
    """Frames in files, read when asked for. A file that can't be read is left out with a warning, and it goes on.

    records: all frames of the original sequence, in order. start, stop, stride: the frames wanted of them.
    size: of the images delivered; the intrinsics follow. crop: see `Tum`; null zooms away the border that
    undistortion leaves. turn_upright: whether the calibration is for the image as EXIF says it should be shown.
    Raises ValueError for options that make no sense and where nothing is selected.
    """

    def __init__(
        self,
        records: Sequence[Record],
        *,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Size = None,
        crop: int | None = None,
        depth_format: DepthFormat | None = None,
        turn_upright: bool = True,
    ) -> None:
        if crop is not None and crop < 0:
            raise ValueError(f"crop is a number of pixels, got {crop}")
        self.records = list(records)[selection(start, stop, stride)]
        if not self.records:
            raise ValueError(f"no frame left: the sequence has {len(records)}, wanted from {start} to {stop}")
        self.warnings: list[str] = Notices()
        self._notices: Notices = self.warnings  # the same list, with its counting
        self._size = size
        self._crop = crop
        self._depth_format = depth_format
        self._turn_upright = turn_upright
        self._undistortions: dict[Lens, Undistortion] = {}
        self._passes = 0
        self._opening_warnings = 0
        target_size(size, (480, 640))  # a bad size fails here and not at the first frame

    def __len__(self) -> int:
        """Frames selected; those that turn out unreadable are not delivered."""
        return len(self.records)

    def __iter__(self) -> Iterator[Item]:
        if self._passes == 0:
            self._opening_warnings = len(self._notices)
        self._passes += 1
        self._notices.truncate(self._opening_warnings)
        index = 0
        delivered: tuple[int, int] | None = None
        for record in self.records:
            try:
                image = read_image(record.image, turn_upright=self._turn_upright)
            except UnreadableImageError as error:
                self._notices.tally("images could not be read and were left out", str(error))
                continue
            item = self._item(index, record, image, delivered)
            if item is not None:
                delivered = item.image.shape[0], item.image.shape[1]
                index += 1
                yield item
        if index == 0:
            raise ValueError("no image could be read: " + "; ".join(self._notices))

    def _item(self, index: int, record: Record, image: np.ndarray, delivered: tuple[int, int] | None) -> Item | None:
        native = image.shape[0], image.shape[1]
        if not same_shape(native, record.lens.size):
            what = "images have another aspect ratio than their camera calibration and were left out"
            self._notices.tally(what, f"{record.image.name}, {_text(native)} for {_text(record.lens.size)}")
            return None
        size = self._size_of(native)
        if delivered is not None and size != delivered:
            example = f"{record.image.name}, {_text(size)} after {_text(delivered)}"
            if not same_shape(size, delivered):
                self._notices.tally("images have another shape than the first and were left out", example)
                return None
            self._notices.tally("images were scaled to the size of the first", example)
            size = delivered
        undistortion = self._undistortion(record.lens.at(native))
        border = self._crop or 0
        padded = size[0] + 2 * border, size[1] + 2 * border
        inside = slice(border, border + size[0]), slice(border, border + size[1])
        intrinsics = scale_intrinsics(undistortion.intrinsics, native, padded) - (0.0, 0.0, border, border)
        depth = self._depth(record, native)
        if depth is not None:
            depth = np.ascontiguousarray(resize_depth(undistortion.depth(depth), padded)[inside])
        resized = resize_image(undistortion.image(image), padded)[inside]
        return Item(index, record.timestamp, np.ascontiguousarray(resized), intrinsics, record.world_from_cam, depth)

    def registered(self, depth: np.ndarray) -> np.ndarray:
        """The depth map (h, w) as the color camera would see it: of most sets it is already."""
        return depth

    def _size_of(self, native: tuple[int, int]) -> tuple[int, int]:
        if self._size is None and self._crop:  # nothing to resize to, so cropping makes the image smaller
            return native[0] - 2 * self._crop, native[1] - 2 * self._crop
        return target_size(self._size, native)

    def _undistortion(self, lens: Lens) -> Undistortion:
        if lens not in self._undistortions:
            self._undistortions[lens] = Undistortion(lens, fill=self._crop is None)
        return self._undistortions[lens]

    def _depth(self, record: Record, native: tuple[int, int]) -> np.ndarray | None:
        """Depth map at the image's size, None where there is none."""
        if self._depth_format is None:
            return None
        if record.depth is None or not record.depth.exists():
            self._notices.tally("frames have no depth map: depth is not scored there", record.image.name)
            return None
        try:
            depth = read_depth(record.depth, self._depth_format.per_unit, self._depth_format.invalid)
        except UnreadableImageError as error:
            self._notices.tally("depth maps could not be read: depth is not scored there", str(error))
            return None
        depth = self.registered(depth)
        if not same_shape((depth.shape[0], depth.shape[1]), native):
            self._notices.tally("depth maps have another shape than their image and were left out", record.image.name)
            return None
        return resize_depth(depth, native)


def _text(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"
