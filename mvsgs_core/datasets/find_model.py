"""The model beside a folder of photographs, whatever wrote it: where it may lie, and what it says of each image."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from pathlib import Path

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets.calibration import size_doubt
from mvsgs_core.datasets.colmap import find_colmap, models_beside, read_colmap
from mvsgs_core.datasets.model import Model
from mvsgs_core.datasets.phone_scans import find_record3d, polycam_folders, read_polycam, read_record3d
from mvsgs_core.datasets.scannetpp import read_scannetpp
from mvsgs_core.datasets.sequence import Record
from mvsgs_core.datasets.strecha import find_strecha, read_strecha
from mvsgs_core.datasets.transforms import NAMES, find_transforms, read_transforms

SUBFOLDERS = ("images", "rgb", "input", "frames")  # of a scene, in which its images lie
RATE = 30.0  # images per second, where nothing says when they were taken


def find_model(
    folder: Path, images: list[Path], given: str | Path | None, size: tuple[int, int], notes: list[str]
) -> Model | None:
    """The model in the folder or file that was `given`, else in the `folder` of the images or around them; None where
    there is none. What is to be said of it goes to `notes`.

    size: (height, width) of most images on disk, for a model that does not say it. Raises FileNotFoundError and
    ValueError where none is where it was given, BadFileError for a malformed one.
    """
    place = folder if given is None else Path(given).expanduser()
    if given is not None and not place.exists():
        raise FileNotFoundError(f"model {place} is missing: a folder with cameras and images of COLMAP, or {NAMES[0]}")
    if given is None and (scannetpp := read_scannetpp(images, size)) is not None:
        return scannetpp
    for base in dict.fromkeys([place, *_around(images[0])] if given is None else [place]):
        transforms = base if base.is_file() else find_transforms(base, place.name)
        colmap = find_colmap(base)
        if colmap is not None:
            return read_colmap(colmap) if colmap == base else _largest(colmap, notes)
        if transforms is not None:
            return read_transforms(transforms, images, size)
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


def records_of(model: Model, folder: Path, images: list[Path], rate: float | None, notes: list[str]) -> list[Record]:
    """Of those images of a folder that the model has a camera for; what is to be said of it goes to `notes`.

    rate: images per second; None: the model's own times, where it has those of all images, else 30. Raises
    BadFileError where it knows none of the images.
    """
    shots = model.lookup(images)
    unknown = [image.name for image, shot in zip(images, shots) if shot is None]
    if len(unknown) == len(images):
        names, here = ", ".join(list(model.shots)[:3]), images[0].relative_to(folder).as_posix()
        raise BadFileError(f"the {model.kind} knows none of the images: it names {names}, here is {here}")
    common = model.common_lens
    said = [shot.time for shot in shots if shot is not None and shot.time is not None]
    times = said if rate is None and len(said) == len(images) else [i / (rate or RATE) for i in range(len(images))]
    records = []
    for time, image, shot in zip(times, images, shots):
        if shot is not None:
            records.append(Record(time, image, shot.lens, shot.world_from_cam, mask=shot.mask))
        elif common is not None:
            records.append(Record(time, image, common))
    if unknown:
        consequence = "they have no true pose" if common is not None else "left out, their camera is unknown"
        notes.append(f"images that the {model.kind} does not know, {consequence}: {len(unknown)} (first: {unknown[0]})")
    usual, _ = Counter(record.lens for record in records).most_common(1)[0]
    notes += [f"{model.kind}: {doubt}" for doubt in size_doubt(usual, "there ")]
    return records


def _largest(first: Path, notes: list[str]) -> Model:
    """Of the COLMAP models that lie beside the first one, the one with most images, which need not be the first."""
    models = {first: read_colmap(first)}
    for other in models_beside(first):
        with suppress(BadFileError):
            models[other] = read_colmap(other)
    best = max(models, key=lambda model: len(models[model].shots))
    if len(models) > 1:
        notes.append(
            f"of {len(models)} COLMAP models in {first.parent}, which share no frame of reference, {best.name} is "
            f"taken, as it knows most images: {len(models[best].shots)}; dataset.options.model=FOLDER takes another"
        )
    return models[best]


def _around(image: Path) -> list[Path]:
    """Folders above an image where its model may be: one more where each camera has a folder in images/."""
    above = list(image.absolute().parents)
    return above[: 3 if len(above) > 1 and above[1].name.partition("_")[0] in SUBFOLDERS else 2]
