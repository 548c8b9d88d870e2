"""Which image of a folder is which of a model: by folders and names, and of no other's pose."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset, recognized
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


def _rig(folder: Path) -> None:
    names = [f"{camera}/{i}.png" for camera in ("cam1", "cam2") for i in range(2)]
    for name in names:
        write_image(folder / "images" / name, 20)
    colmap_text(folder / "sparse/0", names)


@pytest.mark.parametrize("copies", ["input", "dense/0/images", "images_2"])
def test_copies_beside_a_folder_of_each_camera_are_not_read(copies: str, tmp_path: Path) -> None:
    _rig(tmp_path)
    shutil.copytree(tmp_path / "images", tmp_path / copies)
    assert places(tmp_path) == [0.0, 1.0, 2.0, 3.0]
    notes = open_dataset("images", path=tmp_path).warnings
    assert any("images are those below" in w and f"not read: 4 (first: {copies}/cam1/0.png)" in w for w in notes)


@pytest.mark.parametrize(("part", "stand"), [("images", [0.0, 1.0, 2.0, 3.0]), ("images/cam2", [2.0, 3.0])])
def test_a_part_of_a_scene_has_the_model_of_the_scene(
    part: str, stand: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _rig(tmp_path)
    assert recognized(tmp_path / part) == ["images"]
    assert places(tmp_path / part) == stand
    monkeypatch.chdir(tmp_path / part)
    assert recognized(Path()) == ["images"]
    assert places(Path()) == stand


def test_eth3d(tmp_path: Path) -> None:
    scene = tmp_path / "courtyard"
    names = [f"dslr_images_undistorted/DSC_028{i}.JPG" for i in range(2)]
    for name in names:
        write_image(scene / "images" / name, 20)
    colmap_text(scene / "dslr_calibration_undistorted", names)
    for path in (scene, scene / "images", scene / "images/dslr_images_undistorted"):
        assert recognized(path) == ["images"]
        assert places(path) == [0.0, 1.0]


def test_the_mark_that_windows_puts_before_a_text(tmp_path: Path) -> None:
    write_image(tmp_path / "images/0.png", 20)
    colmap_text(tmp_path / "sparse/0", ["0.png"])
    for path in (tmp_path / "sparse/0").iterdir():
        path.write_text(path.read_text(), encoding="utf-8-sig")
    assert places(tmp_path) == [0.0]
