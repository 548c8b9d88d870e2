"""ScanNet++ (Yeshwanth et al., "ScanNet++: A High-Fidelity Dataset of 3D Indoor Scenes", ICCV 2023): its photographs
and its telephone's frames, with the poses and cameras that it keeps for nerfstudio.

The undistorted photographs come before those through the fisheye lens, which the COLMAP model beside them is for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mvsgs_core.datasets.files import images_in
from mvsgs_core.datasets.model import Model
from mvsgs_core.datasets.transforms import read_transforms


@dataclass(frozen=True)
class Part:
    """What belongs together below dslr/ or iphone/."""

    images: str
    transforms: str  # below nerfstudio/
    masks: str  # of faces and the like, black


_PARTS = (
    Part("resized_undistorted_images", "transforms_undistorted.json", "resized_undistorted_masks"),
    Part("undistorted_images", "transforms_undistorted.json", "undistorted_anon_masks"),
    Part("resized_images", "transforms.json", "resized_anon_masks"),
    Part("rgb", "transforms.json", "rgb_masks"),
)


def scannetpp_images(folder: Path) -> Path | None:
    """Images of a scene, or of one of its parts dslr/ and iphone/; None where it is in another layout."""
    for base in (folder, folder / "dslr", folder / "iphone"):
        for part in _PARTS:
            images = base / part.images
            if _transforms(images, part).is_file() and images.is_dir() and images_in(images):
                return images
    return None


def read_scannetpp(images: list[Path], image_size: tuple[int, int]) -> Model | None:
    """Cameras and poses of images, of those that are kept for tests too; None where their folder is none of
    ScanNet++'s. Raises BadFileError for a malformed file."""
    folder = images[0].parent
    for part in _PARTS:
        if folder.name == part.images and (path := _transforms(folder, part)).is_file():
            model = read_transforms(path, images, image_size, masks=folder.parent / part.masks)
            return Model("ScanNet++ model", model.shots)
    return None


def _transforms(images: Path, part: Part) -> Path:
    return images.parent / "nerfstudio" / part.transforms
