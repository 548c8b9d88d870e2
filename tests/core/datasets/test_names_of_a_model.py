"""Which image of a folder is which of a model: by folders and names, and of no other's pose."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from tests.support.dataset_folders import colmap_text, write_image


def places(folder: Path) -> list[float | None]:
    """Of each image of a folder: where its camera stands on the first axis."""
    poses = [item.world_from_cam for item in open_dataset("images", path=folder)]
    return [None if pose is None else round(float(pose[0, 3]), 6) for pose in poses]


def test_an_image_that_the_model_left_out_has_no_other_ones_pose(tmp_path: Path) -> None:
    for name in ("left/0.png", "left/1.png", "right/0.png", "right/1.png"):
        write_image(tmp_path / "images" / name, 20)
    colmap_text(tmp_path / "sparse/0", ["left/0.png", "left/1.png", "right/0.png"])
    assert places(tmp_path) == [0.0, 1.0, 2.0, None]
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "images/sparse/0")
    assert places(tmp_path / "images/right") == [2.0, None], "the model knows its folder"
    shutil.rmtree(tmp_path / "images/sparse")
    colmap_text(tmp_path / "images/sparse/0", ["left/0.png", "left/1.png"])
    with pytest.raises(ValueError, match="knows none of the images"):
        open_dataset("images", path=tmp_path / "images/right")  # beside the folder that the model names
    assert places(tmp_path / "images/left") == [0.0, 1.0]
    shutil.rmtree(tmp_path / "images/sparse")
    colmap_text(tmp_path / "images/sparse/0", ["0.png", "1.png"])
    with pytest.raises(ValueError, match=r"it names 0\.png, 1\.png, here is left/0\.png"):
        open_dataset("images", path=tmp_path / "images")  # whose they are is not said


@pytest.mark.parametrize(
    ("name", "folder"), [("images/0.png", "images_4"), ("images/0.png", "rgb"), ("walk/DCIM/0.jpg", "photos")]
)
def test_a_model_of_images_that_were_moved_or_scaled(name: str, folder: str, tmp_path: Path) -> None:
    write_image(tmp_path / folder / "0.png", 20)
    (tmp_path / "images").mkdir(exist_ok=True)
    colmap_text(tmp_path / "sparse/0", [name])
    assert places(tmp_path / folder) == [0.0]


def test_an_image_beside_the_one_of_the_model_has_no_pose(tmp_path: Path) -> None:
    for name in ("0.jpg", "0.png"):
        write_image(tmp_path / "images" / name, 20)
    colmap_text(tmp_path / "sparse/0", ["0.jpg"])
    assert places(tmp_path) == [0.0, None]


def test_the_parts_of_nerfs_own_sets(tmp_path: Path) -> None:
    for part, x in (("train", 0.0), ("test", 5.0)):
        write_image(tmp_path / part / "r_0.png", 20)
        pose = np.eye(4)
        pose[0, 3] = x
        content = {"camera_angle_x": 0.7, "frames": [{"file_path": f"./{part}/r_0", "transform_matrix": pose.tolist()}]}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(content))
    assert [places(tmp_path / part) for part in ("train", "test")] == [[0.0], [5.0]]
    assert places(tmp_path) == [None, 0.0], "test/ and train/, by the file of train/"
