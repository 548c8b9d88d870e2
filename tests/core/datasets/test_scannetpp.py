"""ScanNet++: undistorted photographs before those through the fisheye lens, its telephone, its masks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset, recognized
from tests.support.dataset_folders import write_image

PINHOLE = {"fl_x": 50.0, "fl_y": 51.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "camera_model": "PINHOLE"}
FISHEYE = {**PINHOLE, "fl_x": 30.0, "fl_y": 30.0, "k1": 0.05, "k2": 0.01, "camera_model": "OPENCV_FISHEYE"}


def frames(names: list[str], first: int = 0) -> list[dict[str, Any]]:
    poses = [np.eye(4) for _ in names]
    for number, pose in enumerate(poses, first):
        pose[0, 3] = number
    mask = [str(Path(name).with_suffix(".png")) for name in names]
    return [
        {"file_path": name, "mask_path": at, "transform_matrix": pose.tolist(), "is_bad": False}
        for name, at, pose in zip(names, mask, poses)
    ]


def part(base: Path, images: str, transforms: str, camera: dict[str, Any]) -> None:
    names = ["DSC001.JPG", "DSC002.JPG", "DSC009.JPG"]
    for brightness, name in enumerate(names, 40):
        write_image(base / images / name, brightness)
    path = base / "nerfstudio" / transforms
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**camera, "frames": frames(names[:2]), "test_frames": frames(names[2:], 2)}))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """As it is downloaded: with a COLMAP model of the fisheye lens, which is no model of the undistorted images."""
    part(tmp_path / "dslr", "resized_images", "transforms.json", FISHEYE)
    part(tmp_path / "dslr", "resized_undistorted_images", "transforms_undistorted.json", PINHOLE)
    part(tmp_path / "iphone", "rgb", "transforms.json", {**PINHOLE, "fl_x": 60.0, "fl_y": 60.0})
    colmap = tmp_path / "dslr" / "colmap"
    colmap.mkdir()
    (colmap / "cameras.txt").write_text("1 OPENCV_FISHEYE 64 48 30 30 32 24 0.05 0.01 0 0\n")
    (colmap / "images.txt").write_text("".join(f"{i} 1 0 0 0 0 0 0 1 DSC00{i}.JPG\n\n" for i in (1, 2, 9)))
    return tmp_path


@pytest.mark.parametrize("below", ["", "dslr", "dslr/resized_undistorted_images"])
def test_the_undistorted_photographs_with_their_own_lens(scene: Path, below: str) -> None:
    assert recognized(scene / below) == ["images"]
    items = list(open_dataset("images", path=scene / below))
    assert len(items) == 3  # those that are kept for tests have poses too
    for number, item in enumerate(items):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 31.5, 23.5])
        assert item.world_from_cam is not None
        assert item.world_from_cam[:3, 3].tolist() == [number, 0, 0]
        assert item.mask is None


def test_the_telephone_and_the_fisheye_lens(scene: Path) -> None:
    np.testing.assert_allclose(next(iter(open_dataset("images", path=scene / "iphone"))).intrinsics[:2], 60)
    fisheye = open_dataset("images", path=scene / "dslr/resized_images")
    assert fisheye.lens.fisheye
    assert len(list(fisheye)) == 3


def test_masks_lie_in_a_folder_of_their_own(scene: Path) -> None:
    folder = scene / "dslr/resized_undistorted_masks"
    folder.mkdir()
    mask = np.full((48, 64), 255, dtype=np.uint8)
    mask[:10] = 0
    for number in (1, 2, 9):
        cv2.imwrite(str(folder / f"DSC00{number}.png"), mask)
    for item in open_dataset("images", path=scene):
        assert item.mask is not None
        np.testing.assert_array_equal(item.mask, mask > 0)
