"""A folder of photographs or frames, calibrated in one of several ways."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import exif_notices, image_size, lens_from_option, with_distortion
from mvsgs_core.datasets.colmap import find_colmap
from mvsgs_core.datasets.exif import exif_doubt, read_exif_exposure, read_exif_lens, read_exif_place, read_exif_time
from mvsgs_core.datasets.files import (
    IMAGE_SUFFIXES,
    Layout,
    UnreadableImageError,
    images_in,
    is_image,
    is_turned,
    natural_order,
    opened_image,
)
from mvsgs_core.datasets.find_model import RATE, SUBFOLDERS, find_model, records_of
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.masks import FOLDERS, masks_of
from mvsgs_core.datasets.phone_scans import polycam_folders
from mvsgs_core.datasets.scannetpp import scannetpp_images
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from mvsgs_core.datasets.transforms import NAMES, find_transforms
from mvsgs_core.run_folder import has_settings

LAYOUT = Layout(
    "A folder of images",
    "photographs or frames (" + ", ".join(IMAGE_SUFFIXES) + ") in the order of their names, in the folder or in its "
    "subfolder images/; beside them, if there is one, a COLMAP model (sparse/0), a transforms.json, .camera files, "
    "or what Polycam (raw data) or Record3D exported; a scene of ScanNet++ or ETH3D; masks (black: ignored) in masks/ "
    "under the images' names",
    "your own camera; frames of a video: ffmpeg -i video.mp4 -qscale:v 2 images/%05d.jpg (or dataset=video directly)",
)
_LOOKED_AT = 1000  # images of which the header is read for their sizes, at most
_MANY = 3  # times as many as beside such a subfolder: those are a preview, a plan, a logo


@dataset
@dataclass(kw_only=True, eq=False)
class Images(ImageSequence):
    """Images in natural order, undistorted where the distortion is known.

    intrinsics: [fx, fy, cx, cy] in pixels of the images, "auto" for EXIF or a guess, null for what is found: files of
    ScanNet++, a COLMAP model, a transforms.json, Strecha's .camera files, an export of Polycam's or Record3D's, whose
    poses then are the ground truth, or EXIF headers, in this order; where there is none of them it is the guess of
    "auto", for the tracker to estimate.
    Raises FileNotFoundError and ValueError, which say what was expected.
    """

    model: str | Path | None = None  # COLMAP model folder, transforms.json or folder of .camera files, if elsewhere
    rate: float | None = None  # images per second, for the timestamps; null: as Record3D recorded them, else 30

    @staticmethod
    def recognizes(path: Path) -> bool:
        places = [place for place in _places(path) if place.is_dir()]
        if any(is_image(file) for place in places for file in place.iterdir()):
            return True
        inside = path.absolute().name in SUBFOLDERS  # with a folder of each camera in it
        scene = path.absolute().parent if inside else path
        subfolder = inside or any((path / name).is_dir() for name in SUBFOLDERS)
        return subfolder and (find_colmap(scene) is not None or find_transforms(scene) is not None)

    def _find(self) -> Found:
        if self.rate is not None and self.rate <= 0:
            raise ValueError(f"rate is a positive number of images per second, got {self.rate}")
        if self.intrinsics is not None and self.model is not None:
            raise ValueError("give intrinsics or model, not both: a model has its own intrinsics")
        folder = LAYOUT.folder(self.path)
        images = _find_images(folder, self.warnings)
        sizes = _Sizes.of(images)
        model = (
            None if self.intrinsics is not None else find_model(folder, images, self.model, sizes.taken, self.warnings)
        )
        mask = None if self.mask is None else Path(self.mask).expanduser()
        one = mask is not None and mask.is_file()
        masks = [mask] * len(images) if one else masks_of(images, folder, mask)
        self._find_times(images)
        if model is not None:
            records = records_of(model, folder, images, self.rate, self.warnings)
            known = dict(zip(images, masks))
            records = [replace(record, mask=record.mask or known[record.image]) for record in records]
            return Found(records, turn_upright=False, size=_Sizes.of([record.image for record in records]).taken)
        turn_upright = sizes.turn_upright(self._given_shapes(sizes, dict(zip(images, masks))))
        if turn_upright:
            sizes.check()
        else:
            self.warnings.append(
                "EXIF turns some of the images by a quarter and others not: all are read as the camera took them, "
                "without a turn, so that intrinsics and masks are of one shape; evaluator.camera_up=true is not for "
                "them, as the upper side of such an image need not be up"
            )
        size = sizes.shown(turn_upright)
        found = enumerate(zip(images, self._lenses(images, size, turn_upright), masks))
        records = [Record(i / (self.rate or RATE), image, lens, mask=mask) for i, (image, lens, mask) in found]
        return Found(records, turn_upright=turn_upright, size=size)

    def _given_shapes(self, sizes: _Sizes, masks: dict[Path, Path | None]) -> list[tuple[float, float]]:
        """(height, width) that the given intrinsics, and a mask of an image that EXIF turns, are for; to a factor."""
        shapes: list[tuple[float, float]] = []
        if self.intrinsics is not None and not isinstance(self.intrinsics, str):
            _, _, cx, cy = lens_from_option(self.intrinsics, self.distortion, sizes.taken)[0].intrinsics
            shapes.append((cy, cx))
        for path in (masks[image] for image in sizes.turned):
            if path is not None:
                with suppress(UnreadableImageError), opened_image(path, path.name) as opened:
                    return [*shapes, (opened.height, opened.width)]
        return shapes

    def _lenses(self, images: list[Path], size: tuple[int, int], turn_upright: bool) -> list[Lens]:
        """size: (height, width) of an image whose lens is given or guessed."""
        if self.intrinsics not in (None, "auto"):
            lens, notices = lens_from_option(self.intrinsics, self.distortion, size)
            self.warnings += notices
            return [lens] * len(images)
        found = [read_exif_lens(image, turn_upright=turn_upright) for image in images]
        known = [
            (image, lens) for image, lens in zip(images, found) if lens is not None and same_shape(lens.size, size)
        ]
        unknown = [image for image, lens in zip(images, found) if lens is None]
        doubt = exif_doubt(unknown[0]) if unknown else ""
        self.warnings += [doubt] if doubt else []
        if not known:
            lens, warnings = lens_from_option("auto", self.distortion, size)
            where = f"{images[0].parent}: neither a COLMAP model (sparse/0), a {NAMES[0]} nor EXIF focal lengths"
            nothing = [f"no calibration for {where} were found"] if self.intrinsics is None else []
            self.warnings += [*nothing, *warnings]
            return [lens] * len(images)
        image, first = known[0]
        self.warnings += exif_notices(image, first, self.distortion)
        if unknown:
            self.warnings.append(f"images without an EXIF focal length, which take the first one's: {len(unknown)}")
        return [with_distortion(lens if lens is not None else first, self.distortion) for lens in found]

    def _find_times(self, images: list[Path]) -> None:
        """When photographs were taken, for places of a clock's times; frames of a video have their rate instead.

        Raises ValueError where it is not known in what time zone, or whether they are frames of a video.
        """
        self._taken: dict[Path, float] | None = None  # seconds since the first one
        self._first_taken: datetime | None = None
        if self._gps is None or not self._gps.on_a_clock:
            return
        times = {image: taken for image in images if (taken := read_exif_time(image)) is not None}
        if not times and self.gps_start is None:
            raise ValueError(
                f"{self.gps} has times of a clock, and EXIF says of no image when it was taken: for photographs give a "
                ".csv with their names and places; for frames of a video set dataset.gps_start=2026-01-31T12:00:00Z, "
                "the time of the first, and dataset.options.rate"
            )
        if self.gps_start is None:
            image, local = next(iter(times.items()))
            times = {image: taken for image, taken in times.items() if taken.tzinfo is not None}
            if not times:
                raise ValueError(
                    f"{self.gps} has times of a clock, and EXIF does not say in what zone the camera's was: set "
                    f"dataset.gps_start={local.isoformat()}+02:00, the time of {image.name}, with the zone of that, or "
                    "another time where the camera's clock was wrong"
                )
        else:
            times = {image: taken.replace(tzinfo=None) for image, taken in times.items()}
        if times:
            self._first_taken = next(iter(times.values()))
            self._taken = {image: (taken - self._first_taken).total_seconds() for image, taken in times.items()}

    def _seconds(self, record: Record) -> float | None:
        if self._taken is None:
            return record.timestamp
        if record.image not in self._taken:
            self._notices.tally("photographs whose EXIF does not say when they were taken", record.image.name)
        return self._taken.get(record.image)

    def _began(self) -> str | None:
        return None if self._first_taken is None else self._first_taken.isoformat()

    def _exposure(self, record: Record) -> float:
        return read_exif_exposure(record.image)

    def _own_place(self, record: Record) -> np.ndarray | None:
        place = read_exif_place(record.image)
        if place is not None and np.isnan(place[2]):
            self._notices.tally("photographs whose GPS has no altitude, and is not used", record.image.name)
            return None
        return place


def _places(folder: Path) -> list[Path]:
    """Where the images may be; exports of an app come first, beside which it puts a picture of the whole."""
    polycam, scannetpp = polycam_folders(folder), scannetpp_images(folder)
    special = [polycam[0]] if polycam else [scannetpp] if scannetpp else []
    return [*special, folder, *(folder / name for name in SUBFOLDERS)]


def _find_images(folder: Path, notes: list[str]) -> list[Path]:
    """The images in the folder, in one of its subfolders, or anywhere below, of a subfolder first, beside which copies
    may lie; what is left out is told in `notes`."""
    found = {place: images for place in _places(folder) if place.is_dir() and (images := images_in(place))}
    place = next(iter(found), folder)
    inner = next((inner for inner in found if inner.parent == folder and inner.name in SUBFOLDERS), place)
    if place == folder and len(found.get(inner, ())) >= _MANY * len(found.get(folder, ())):
        place = inner
    if place in found:
        images, where = found[place], "directly in"
        left = [p for p in _below(place) if p.parent != place]
        if place.parent == folder and place.name in SUBFOLDERS:
            left += found.get(folder, [])
    else:
        where = "below"
        for place in (*(folder / name for name in SUBFOLDERS), folder):
            if images := _below(place):
                break
        left = [] if place == folder else [p for p in _below(folder) if not p.is_relative_to(place)]
    if not images:
        raise LAYOUT.missing(f"{folder} has no image")
    images = _once_each(images, notes)
    if left:
        names = f"{len(left)} (first: {left[0].relative_to(folder).as_posix()})"
        notes.append(f"the images are those {where} {place}; others in {folder} that are not read: {names}")
    return images


def _once_each(images: list[Path], notes: list[str]) -> list[Path]:
    """Without the copies of pictures that were converted: NAME.png beside NAME.jpg."""
    suffixes = Counter(image.suffix for image in images)
    first = max(suffixes, key=lambda suffix: (suffixes[suffix], suffix.lower() != ".png"))
    kept = {image.with_suffix("") for image in images if image.suffix == first}
    copies = [image for image in images if image.suffix != first and image.with_suffix("") in kept]
    if len(copies) < 2:  # no habit: they may be two pictures
        return images
    notes.append(
        f"images that are there as {first}, too, and are left out: {len(copies)} (first: {copies[0].name}); if they "
        "are other pictures, put them into a folder of their own"
    )
    return [image for image in images if image not in set(copies)]


def _below(place: Path) -> list[Path]:
    """All images in a folder and in those below it, in natural order."""
    below = [p for p in place.rglob("*") if is_image(p) and not _is_aside(p, place)]
    return sorted(below, key=lambda p: natural_order(p.relative_to(place).as_posix()))


def _is_aside(path: Path, folder: Path) -> bool:
    """Whether it is in a folder of masks, a hidden one, or one in which a run has left pictures of its map."""
    names = path.relative_to(folder).parts[:-1]
    named = any(name.lower() in FOLDERS or name.startswith(".") for name in names)
    return named or any(has_settings(parent) for parent in path.parents[: len(names)])


@dataclass(frozen=True)
class _Sizes:
    """What sizes (height, width) the images have, of many some; those that cannot be read are no matter."""

    on_disk: dict[Path, tuple[int, int]]  # as the camera took them
    upright: dict[Path, tuple[int, int]]  # as EXIF says that they should be shown

    @classmethod
    def of(cls, images: list[Path]) -> _Sizes:
        """Raises BadFileError where none can be read."""
        on_disk, upright = {}, {}
        for path in images[:: -(-len(images) // _LOOKED_AT)]:
            with suppress(UnreadableImageError), opened_image(path, path.name) as opened:
                on_disk[path] = opened.height, opened.width
                upright[path] = on_disk[path][::-1] if is_turned(opened) else on_disk[path]
        if not on_disk:
            on_disk = upright = {images[0]: image_size(images)}
        return cls(on_disk, upright)

    @property
    def taken(self) -> tuple[int, int]:
        """The most frequent one on disk."""
        return _most_frequent(self.on_disk.values())

    @property
    def turned(self) -> list[Path]:
        """Images that EXIF turns by a quarter."""
        return [path for path, size in self.on_disk.items() if size != self.upright[path]]

    def turn_upright(self, given: list[tuple[float, float]]) -> bool:
        """Whether to read images as EXIF says: unless they have one shape only as the camera took them.

        given: (height, width) of what was given for the images, which then decides.
        """
        if not _of_other_shape(self.upright) or _of_other_shape(self.on_disk):
            return True
        height, width = self.taken
        return any((h > w) != (height > width) for h, w in given)

    def shown(self, turn_upright: bool) -> tuple[int, int]:
        """The most frequent one as images are read, of those in the first image's shape."""
        sizes = self.upright if turn_upright else self.on_disk
        first = next(iter(sizes.values()))
        return _most_frequent(size for size in sizes.values() if same_shape(size, first))

    def check(self) -> None:
        """Raises ValueError where most images would be left out, as they have another shape than the first."""
        others = _of_other_shape(self.upright)
        if 2 * len(others) > len(self.upright):
            first, shape = next(iter(self.upright.items()))
            height, width = self.upright[others[0]]
            raise ValueError(
                f"{len(others)} of {len(self.upright)} images have another shape than the first, {first.name} of "
                f"{shape[1]}x{shape[0]}: {others[0].name} is {width}x{height}; one camera's images of one shape make "
                "a map: put the others into a folder of their own, or turn them"
            )


def _most_frequent(sizes: Iterable[tuple[int, int]]) -> tuple[int, int]:
    return Counter(sizes).most_common(1)[0][0]


def _of_other_shape(sizes: dict[Path, tuple[int, int]]) -> list[Path]:
    """Than the first."""
    first = next(iter(sizes.values()))
    return [path for path, size in sizes.items() if not same_shape(size, first)]
