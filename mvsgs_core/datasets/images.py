"""A folder of photographs or frames, calibrated in one of several ways."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import dataset
from mvsgs_core.datasets.calibration import exif_notice, image_size, lens_from_option, with_distortion
from mvsgs_core.datasets.colmap import find_colmap, read_colmap
from mvsgs_core.datasets.exif import read_exif_exposure, read_exif_lens, read_exif_place
from mvsgs_core.datasets.files import (
    IMAGE_SUFFIXES,
    Layout,
    UnreadableImageError,
    images_in,
    is_mask_beside,
    natural_order,
    opened_image,
    upright_size,
)
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.masks import FOLDERS, masks_of
from mvsgs_core.datasets.model import Model
from mvsgs_core.datasets.phone_scans import find_record3d, polycam_folders, read_polycam, read_record3d
from mvsgs_core.datasets.scannetpp import read_scannetpp, scannetpp_images
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from mvsgs_core.datasets.strecha import find_strecha, read_strecha
from mvsgs_core.datasets.transforms import NAMES, find_transforms, read_transforms

LAYOUT = Layout(
    "A folder of images",
    "photographs or frames (" + ", ".join(IMAGE_SUFFIXES) + ") in the order of their names, in the folder or in its "
    "subfolder images/; beside them, if there is one, a COLMAP model (sparse/0), a transforms.json, .camera files, "
    "or what Polycam (raw data) or Record3D exported; a scene of ScanNet++; masks (black: ignored) in masks/ under the "
    "images' names",
    "your own camera; frames of a video: ffmpeg -i video.mp4 -qscale:v 2 images/%05d.jpg (or dataset=video directly)",
)
_SUBFOLDERS = ("images", "rgb", "input", "frames")


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
    rate: float = 30.0  # images per second, for the timestamps

    @staticmethod
    def recognizes(path: Path) -> bool:
        places = [place for place in _places(path) if place.is_dir()]
        if any(file.suffix.lower() in IMAGE_SUFFIXES for place in places for file in place.iterdir()):
            return True
        subfolder = any((path / name).is_dir() for name in _SUBFOLDERS)  # with a folder of each camera in it
        return subfolder and (find_colmap(path) is not None or find_transforms(path) is not None)

    def _find(self) -> Found:
        if self.rate <= 0:
            raise ValueError(f"rate is a positive number of images per second, got {self.rate}")
        if self.intrinsics is not None and self.model is not None:
            raise ValueError("give intrinsics or model, not both: a model has its own intrinsics")
        folder = LAYOUT.folder(self.path)
        images = _find_images(folder)
        model = None if self.intrinsics is not None else _find_model(folder, images, self.model)
        masks = masks_of(images, folder) if self.mask is None else [None] * len(images)
        if model is not None:
            records = _from_model(model, folder, images, self.rate, self.warnings)
            known = dict(zip(images, masks))
            records = [replace(record, mask=record.mask or known[record.image]) for record in records]
            return Found(records, turn_upright=False)
        _check_shapes(images)
        lenses = self._lenses(images)
        found = enumerate(zip(images, lenses, masks))
        return Found([Record(i / self.rate, image, lens, mask=mask) for i, (image, lens, mask) in found])

    def _lenses(self, images: list[Path]) -> list[Lens]:
        if self.intrinsics is not None:
            return [self._given_lens(images, self.intrinsics)] * len(images)
        found = [read_exif_lens(image) for image in images]
        known = [lens for lens in found if lens is not None]
        if not known:
            lens, warnings = lens_from_option("auto", self.distortion, image_size(images))
            where = f"{images[0].parent}: neither a COLMAP model (sparse/0), a {NAMES[0]} nor EXIF focal lengths"
            self.warnings += [f"no calibration for {where} were found", *warnings]
            return [lens] * len(images)
        self.warnings.append(exif_notice(known[0], self.distortion))
        if len(known) < len(images):
            without = len(images) - len(known)
            self.warnings.append(f"images without an EXIF focal length, which take the first one's: {without}")
        return [with_distortion(lens if lens is not None else known[0], self.distortion) for lens in found]

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
    return [*special, folder, *(folder / name for name in _SUBFOLDERS)]


def _find_images(folder: Path) -> list[Path]:
    for candidate in _places(folder):
        images = images_in(candidate) if candidate.is_dir() else []
        if images:
            return images
    below = [p for p in folder.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and not _is_mask(p, folder)]
    if not below:
        raise LAYOUT.missing(f"{folder} has no image")
    return sorted(below, key=lambda p: natural_order(p.relative_to(folder).as_posix()))


def _is_mask(path: Path, folder: Path) -> bool:
    return is_mask_beside(path) or any(part.lower() in FOLDERS for part in path.relative_to(folder).parts[:-1])


def _check_shapes(images: list[Path]) -> None:
    """Raises ValueError where most images would be left out, as they have another shape than the first. Looks at a
    hundred of them at most; those that cannot be read are no matter of shape."""
    shapes: dict[Path, tuple[int, int]] = {}
    for path in images[:: -(-len(images) // 100)]:
        with suppress(UnreadableImageError), opened_image(path, path.name) as opened:
            shapes[path] = upright_size(opened)
    if not shapes:
        return
    first, shape = next(iter(shapes.items()))
    others = [path for path, other in shapes.items() if not same_shape(other, shape)]
    if 2 * len(others) > len(shapes):
        height, width = shapes[others[0]]
        raise ValueError(
            f"{len(others)} of {len(shapes)} images have another shape than the first, {first.name} of "
            f"{shape[1]}x{shape[0]}: {others[0].name} is {width}x{height}; one camera's images of one shape make "
            "a map: put the others into a folder of their own, or turn them"
        )


def _find_model(folder: Path, images: list[Path], given: str | Path | None) -> Model | None:
    place = folder if given is None else Path(given).expanduser()
    if given is not None and not place.exists():
        raise FileNotFoundError(f"model {place} is missing: a folder with cameras and images of COLMAP, or {NAMES[0]}")
    if given is None and (scannetpp := read_scannetpp(images[0].parent, image_size(images))) is not None:
        return scannetpp
    for base in dict.fromkeys((place, images[0].parent, images[0].parent.parent) if given is None else (place,)):
        transforms = base if base.is_file() else find_transforms(base, place.name)
        colmap = find_colmap(base)
        if colmap is not None:
            return read_colmap(colmap)
        if transforms is not None:
            return read_transforms(transforms, image_size(images))
        strecha = find_strecha(base)
        if strecha is not None:
            return read_strecha(strecha)
        polycam = polycam_folders(base)
        if polycam is not None:
            return read_polycam(polycam[1])
        record3d = find_record3d(base)
        if record3d is not None:
            return read_record3d(record3d)
    if given is not None:
        raise ValueError(f"model {place} is neither a COLMAP model, nor a {NAMES[0]}, nor a folder of .camera files")
    return None


def _from_model(model: Model, folder: Path, images: list[Path], rate: float, notes: list[str]) -> list[Record]:
    shots = model.lookup(images)
    unknown = [image.name for image, shot in zip(images, shots) if shot is None]
    if len(unknown) == len(images):
        names, here = ", ".join(list(model.shots)[:3]), images[0].relative_to(folder).as_posix()
        raise BadFileError(f"the {model.kind} knows none of the images: it names {names}, here is {here}")
    common = model.common_lens
    records = []
    for i, (image, shot) in enumerate(zip(images, shots)):
        if shot is not None:
            records.append(Record(i / rate, image, shot.lens, shot.world_from_cam, mask=shot.mask))
        elif common is not None:
            records.append(Record(i / rate, image, common))
    if unknown:
        consequence = "they have no true pose" if common is not None else "left out, their camera is unknown"
        notes.append(f"images that the {model.kind} does not know, {consequence}: {len(unknown)} (first: {unknown[0]})")
    return records
