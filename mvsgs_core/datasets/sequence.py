"""Base of the readers of image files: selection, size, undistortion, and what happens to files that are broken."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.by_time import check_times, standstill
from mvsgs_core.datasets.calibration import lens_for_images, with_distortion
from mvsgs_core.datasets.files import UnreadableImageError, dark_16_bit, read_depth, read_image
from mvsgs_core.datasets.framing import Framing, same_shape
from mvsgs_core.datasets.gps import CLOCK, PlacesInTime, clock_time, read_gps
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.masks import CameraMask, masks_of, read_alpha, read_mask
from mvsgs_core.datasets.options import FileOptions

_SAMPLED = 5  # images at most, for what is the same in all of them


@dataclass(frozen=True)
class Record:
    """A frame before it is read."""

    timestamp: float  # seconds
    image: Path
    lens: Lens
    world_from_cam: np.ndarray | None = None  # (4, 4) float64
    depth: Path | None = None
    mask: Path | None = None  # that was named, or lies beside the image


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


@dataclass(kw_only=True, eq=False)
class FileReader(FileOptions):
    """Base of the readers of files. Raises ValueError for options that make no sense."""

    # pixels to cut off after undistortion; null: zoom to hide the border that it leaves
    crop: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._framing = Framing(self.size, self.crop)
        self._gps = None if self.gps is None else read_gps(Path(self.gps).expanduser())
        self._camera_mask: CameraMask | None = None  # once the camera is known
        self.warnings: list[str] = Notices()
        self._notices: Notices = self.warnings  # the same list, with its counting
        self.warnings += [] if self._gps is None else self._gps.warnings
        self._places: PlacesInTime | None = None
        self._placed = 0  # frames with a place of the file

    def _place(self, timestamp: float, began: Callable[[], str | None] | None = None) -> np.ndarray | None:
        """The place (3,) of the next frame, in the order of the stream; None where dataset.gps has none for it.

        began: asked when timestamp 0 was, as the file says, ISO 8601. Raises ValueError where a clock's times meet a
        stream of which it is not known when it was taken.
        """
        if self._gps is None:
            return None
        if self._places is None:
            self._places = PlacesInTime(self._gps, self._start_of_clock(timestamp, began))
        place = self._places.place(timestamp)
        self._placed += place is not None
        return place

    def _start_of_clock(self, first: float, began: Callable[[], str | None] | None) -> float | None:
        assert self._gps is not None
        if not self._gps.on_a_clock or first > CLOCK:
            if self.gps_start is not None:
                raise ValueError(f"dataset.gps_start is for times of a clock in {self.gps}, and frames without them")
            return None
        said = self.gps_start or (began() if began is not None else None)
        if said is None:
            raise ValueError(
                f"{self.gps} has times of a clock, and the frames do not say when they were taken: set "
                "dataset.gps_start=2026-01-31T12:00:00Z, the time of the first frame"
            )
        if self.gps_start is None:
            self.warnings.append(
                f"the first frame is taken to be of {said}, as the file says; dataset.gps_start changes it"
            )
        with reading("dataset.gps_start" if self.gps_start else "the first frame", "has no time of ISO 8601"):
            return clock_time(said)

    def _end_places(self) -> None:
        """To be called when the frames have ended."""
        if self._places is not None and (doubt := self._places.doubt()):
            self.warnings.append(f"{self.gps} has {doubt}")
        elif self._gps is not None and not self._placed:
            self.warnings.append(f"no frame has a place in {self.gps}: {self._gps.misses}")
        self._places, self._placed = None, 0  # of a second pass

    def _check_distortion(self, lens: Lens) -> None:
        """Raises ValueError where the data has a lens of its own, and the distortion that was given is not used."""
        if self.intrinsics is None and with_distortion(lens, self.distortion) != lens:
            raise ValueError(
                "dataset.distortion is not used beside the calibration that the data has: give "
                "dataset.intrinsics=[fx,fy,cx,cy], or auto, too, which replaces it"
            )

    def _open_mask(self, size: tuple[int, int]) -> None:
        """Of images (height, width). Raises FileNotFoundError and ValueError for a mask that cannot be theirs."""
        if self.mask is not None:
            self._camera_mask = CameraMask(self.mask, size)
            self.warnings += self._camera_mask.notices


@dataclass(frozen=True)
class Found:
    """What a reader of image files finds: all frames of the original sequence, in order."""

    records: Sequence[Record]
    depth_format: DepthFormat | None = None  # None: there are no depth maps
    turn_upright: bool = True  # whether the calibration is for the image as EXIF says it should be shown
    size: tuple[int, int] | None = None  # (height, width) on disk that all are scaled to; None: that of the first


@dataclass(kw_only=True, eq=False)
class ImageSequence(FileReader, ABC):
    """Frames in files, read when asked for. A file that can't be read is left out with a warning, and it goes on.

    Raises FileNotFoundError and ValueError, which say what was expected, ValueError where nothing is selected and for a
    frame at no time in seconds too, and BadFileError while iterating where not one image can be read.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        found = self._find()
        check_times([(record.timestamp, record.image.name) for record in found.records])
        self.records = list(found.records)[self.wanted]
        if not self.records:
            count = len(found.records)
            raise ValueError(f"no frame left: the sequence has {count}, wanted from {self.start} to {self.stop}")
        self._check_distortion(self.lens)
        self._depth_format, self._turn_upright, self._size = found.depth_format, found.turn_upright, found.size
        if self._size is not None:
            self._framing.size_of(self._size)  # refused here, before its steps are measured
        self._find_masks()
        sample = [record.image for record in self.records[:: -(-len(self.records) // _SAMPLED)]]
        if dark_16_bit(sample):
            self.warnings.append(
                f"none of {len(sample)} images, such as {sample[0].name}, has a value above 4095 of 65535, as where 12 "
                "bits are stored in 16: they are read nearly black. Multiply the values of all by one number (16 for "
                "12 bits), with ImageMagick in their folder: mkdir bright; mogrify -path bright -evaluate multiply 16 "
                f"*{sample[0].suffix}"
            )
        self.warnings += standstill([(record.timestamp, record.image.name) for record in self.records])
        self._named: dict[Path, np.ndarray] = {}
        self._find_named_places()
        self._opening_warnings = len(self.warnings)

    @property
    def lens(self) -> Lens:
        """The first frame's, at the size that its calibration is for."""
        return self.records[0].lens

    @abstractmethod
    def _find(self) -> Found:
        """What there is; warnings go to `self.warnings`."""

    def _find_masks(self) -> None:
        """Of all images one, or each its own; one of each that was named goes before what lies beside the images."""
        if self.mask is not None and not Path(self.mask).expanduser().is_dir():
            self._open_mask(self.lens.size)
            self.records = [replace(record, mask=None) for record in self.records]
            return
        given = None if self.mask is None else Path(self.mask).expanduser()
        if given is not None:
            images = [record.image for record in self.records]
            found = masks_of(images, _common_folder(images), given)
            self.records = [replace(record, mask=mask) for record, mask in zip(self.records, found)]
        self._masked = any(record.mask is not None for record in self.records)
        if self._masked and not any(record.mask is not None and record.mask.is_file() for record in self.records):
            named = next(record.mask for record in self.records if record.mask is not None)
            raise FileNotFoundError(f"not one of the masks of the images is there, such as {named}")

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

    def successive(self, firsts: Iterable[int], enough: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Two images (H, W, 3) that follow each other, of `enough` pixels or more and not undistorted, and the
        intrinsics (4,) of the first, of each place in `firsts`; none of those that iterating would leave out."""
        for place in firsts:
            here, there = self.records[place], self.records[place + 1]
            try:
                images = [
                    read_image(record.image, turn_upright=self._turn_upright, enough=enough) for record in (here, there)
                ]
            except UnreadableImageError:
                continue
            sizes = [(image.shape[0], image.shape[1]) for image in images]
            if same_shape(sizes[0], here.lens.size) and same_shape(sizes[1], sizes[0]):
                yield images[0], images[1], np.array(here.lens.at(sizes[0]).intrinsics)

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)
        index = 0
        usual = self._size  # on disk
        for record in self.records:
            try:
                image = read_image(record.image, turn_upright=self._turn_upright)
            except UnreadableImageError as error:
                self._notices.tally("images left out because they could not be read", str(error))
                continue
            item = self._item(index, record, image, usual)
            if item is not None:
                usual = usual or (image.shape[0], image.shape[1])
                index += 1
                yield item
        self._end_places()
        if index == 0:
            raise BadFileError("no image could be read: " + "; ".join(self._notices))

    def _item(self, index: int, record: Record, image: np.ndarray, usual: tuple[int, int] | None) -> Item | None:
        native = image.shape[0], image.shape[1]
        if not same_shape(native, record.lens.size):
            what = "images left out because their calibration is for another aspect ratio"
            self._notices.tally(what, f"{record.image.name}, {_text(native)} for {_text(record.lens.size)}")
            return None
        if usual is not None and native != usual:
            example = f"{record.image.name}, {_text(native)} for {_text(usual)}"
            if not same_shape(native, usual):
                self._notices.tally("images left out because they have another aspect ratio than the others", example)
                return None
            self._notices.tally("images scaled to the size of the others", example)
        if index == 0:
            self.warnings += self._framing.notice(usual or native)
        size = self._framing.size_of(usual or native)
        lens = record.lens.at(native)
        try:
            framed, intrinsics = self._framing.image(image, lens, size)
        except ValueError as error:
            what = "images left out because their distortion cannot be undone"
            self._notices.tally(what, f"{record.image.name}, {error}")
            return None
        try:
            mask = self._mask(record, lens, size)
        except ValueError as error:  # whole, it would put into the map what is not to be there
            self._notices.tally("images left out because of their masks", str(error))
            return None
        depth = self._depth(record, native)
        if depth is not None:
            depth = self._framing.depth(depth, lens, size)
        pose, exposure = record.world_from_cam, self._exposure(record)
        place = self._own_place(record) if self._gps is None else self._given_place(record)
        original = np.array(record.lens.at(usual or native).intrinsics, np.float64)
        return Item(
            index, record.timestamp, framed, intrinsics, pose, depth, lens.guessed, exposure, place, mask, original
        )

    def _own_place(self, record: Record) -> np.ndarray | None:
        """As in `Item`: of most sets nothing is known of it."""
        return None

    def _find_named_places(self) -> None:
        """Of the images that dataset.gps names."""
        if self._gps is None:
            return
        self._named, unsure = self._gps.places_by_name([record.image for record in self.records])
        if unsure:
            self.warnings.append(
                f"images without a place, as several have the name in {self.gps}, which should have their folders too: "
                f"{len(unsure)} (first: {unsure[0].name})"
            )

    def _given_place(self, record: Record) -> np.ndarray | None:
        """By dataset.gps: of the image's name, else of its time."""
        named, seconds = self._named.get(record.image), self._seconds(record)
        if named is None:
            return None if seconds is None else self._place(seconds, self._began)
        self._placed += 1
        return named

    def _seconds(self, record: Record) -> float | None:
        """When an image was taken, as `_began` counts; None where that is not known."""
        return record.timestamp

    def _began(self) -> str | None:
        """When the second 0 was, ISO 8601; None where that is not known."""
        return None

    def _mask(self, record: Record, lens: Lens, size: tuple[int, int]) -> np.ndarray | None:
        """(h, w) bool at `size`, None where every pixel counts. Raises ValueError for a mask that cannot be used."""
        if self._camera_mask is not None:
            return self._camera_mask.framed(self._framing, lens, size)
        if record.mask is None:
            source, mask = record.image, read_alpha(record.image, turn_upright=self._turn_upright)
            if mask is not None and not mask.any():  # a program filled the channel with zeros
                what = "images that are transparent everywhere, which is taken for no mask: every pixel counts"
                self._notices.tally(what, source.name)
                return None
        else:
            source, mask = record.mask, None
            if record.mask.is_file():
                mask = read_mask(record.mask, turn_upright=self._turn_upright)
        if mask is None:
            if self._masked:
                self._notices.tally("images without a mask, of which every pixel counts", record.image.name)
            return None
        if not same_shape((mask.shape[0], mask.shape[1]), lens.size):
            raise ValueError(f"{source.name} is {_text(mask.shape)} for an image of {_text(lens.size)}")
        mask = self._framing.mask(mask, lens, size)
        if not mask.any():
            raise ValueError(f"{source.name} leaves no pixel of its image: what is black or transparent is ignored")
        return None if mask.all() else mask

    def _exposure(self, record: Record) -> float:
        """As in `Item`: of most sets nothing is known of it."""
        return 0.0

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        """The depth map (h, w) as the color camera would see it: of most sets it is already."""
        return depth

    def _read_depth(self, path: Path, form: DepthFormat) -> np.ndarray:
        """(H, W) float32 in the poses' unit, 0 where unknown. Raises UnreadableImageError."""
        return read_depth(path, form.per_unit, form.invalid)

    def _depth(self, record: Record, native: tuple[int, int]) -> np.ndarray | None:
        """Depth map as it is on disk, None where there is none."""
        if self._depth_format is None:
            return None
        if record.depth is None or not record.depth.exists():
            self._notices.tally("frames without a depth map, where depth is not scored", record.image.name)
            return None
        try:
            depth = self._read_depth(record.depth, self._depth_format)
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


def _common_folder(images: Sequence[Path]) -> Path:
    return Path(os.path.commonpath([image.parent for image in images]))


def _text(size: tuple[int, ...]) -> str:
    return f"{size[1]}x{size[0]}"
