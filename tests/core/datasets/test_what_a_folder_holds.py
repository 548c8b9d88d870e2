"""Of what lies in a folder of images, what is taken and in which order; and calibrations that are of other images."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.calibration import lens_from_option
from tests.support.dataset_folders import colmap_text, write_image, write_photos


def test_names_that_are_times_are_in_their_order(tmp_path: Path) -> None:
    names = ["9.067.png", "9.1.png", "10.0333.png", "10.2.png"]
    for k, name in enumerate(names):
        write_image(tmp_path / name, 20 + k)
    assert [item.image[0, 0, 0] for item in open_dataset("images", path=tmp_path)] == [20, 21, 22, 23]


@pytest.mark.parametrize("copies", [2, 3])
def test_of_pictures_that_are_there_in_two_formats_one_is_taken(tmp_path: Path, copies: int) -> None:
    write_photos(tmp_path, 4)
    for path in sorted(tmp_path.iterdir())[:copies]:
        Image.open(path).save(path.with_suffix(".jpg"))
    write_image(tmp_path / "zebra.jpg", 90)  # the only one of its name
    sequence = open_dataset("images", path=tmp_path)
    assert [round(int(item.image[0, 0, 0]), -1) for item in sequence] == [20, 20, 20, 20, 90]
    first, left = (".png", "photo0.jpg") if copies == 2 else (".jpg", "photo0.png")
    told = f"images that are there as {first}, too, and are left out: {copies} (first: {left})"
    assert any(text.startswith(told) for text in sequence.warnings)


def test_of_several_colmap_models_the_largest_is_taken(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 4)
    names = [f"photo{k}.png" for k in range(4)]
    colmap_text(tmp_path / "sparse/0", names[:1])
    colmap_text(tmp_path / "sparse/1", names[1:])
    (tmp_path / "sparse/2").mkdir()
    (tmp_path / "sparse/2/cameras.txt").write_text("damaged")
    (tmp_path / "sparse/2/images.txt").write_text("")
    sequence = open_dataset("images", path=tmp_path)
    assert sum(item.world_from_cam is not None for item in sequence) == 3
    told = f"of 2 COLMAP models in {tmp_path / 'sparse'}, which share no frame of reference, 1 is taken"
    assert any(text.startswith(told) for text in sequence.warnings)
    first = open_dataset("images", path=tmp_path, model=tmp_path / "sparse/0")
    assert sum(item.world_from_cam is not None for item in first) == 1


@pytest.mark.parametrize(
    ("center", "size"),
    [((15.5, 11.5), (48, 64)), ((47.5, 35.5), (48, 64)), ((159.5, 119.5), (270, 480)), ((320, 240), (720, 1280))],
)
def test_a_calibration_of_another_size_is_said(center: tuple[float, float], size: tuple[int, int]) -> None:
    """Half and one and a half of it, and a usual one of another shape."""
    (told,) = lens_from_option([50, 51, *center], [], size)[1]
    assert f"of another size (about {2 * center[0] + 1:.0f}x{2 * center[1] + 1:.0f})" in told
