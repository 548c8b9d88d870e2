"""Lenses of models beside photographs: for images of which size, and those that cannot be theirs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from tests.support.dataset_folders import colmap_text, write_image, write_photos


def write_transforms(folder: Path, frames: list[dict[str, Any]], **common: Any) -> None:
    poses = {"transform_matrix": np.eye(4).tolist()}
    named = [{"file_path": f"images/photo{i}.png"} | poses | frame for i, frame in enumerate(frames)]
    (folder / "transforms.json").write_text(json.dumps({"frames": named} | common))


def test_a_frames_own_intrinsics_are_for_its_own_image(tmp_path: Path) -> None:
    """Where the file says no sizes."""
    write_photos(tmp_path / "images", 3)
    write_image(tmp_path / "images/photo1.png", 21, (96, 128))
    small = {"fl_x": 50.0, "fl_y": 51.0, "cx": 30.0, "cy": 22.0}
    frames = [small, {name: 2.0 * value for name, value in small.items()}, small]
    write_transforms(tmp_path, frames)
    for item in open_dataset("images", path=tmp_path):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 29.5, 21.5])
    write_transforms(tmp_path, frames, w=128, h=96)
    focal = [item.intrinsics[0] for item in open_dataset("images", path=tmp_path)]
    assert focal == [25.0, 50.0, 25.0], "the file says for what"
    write_transforms(tmp_path, [{}] * 3, **small)
    for item in open_dataset("images", path=tmp_path):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 29.5, 21.5])


@pytest.mark.parametrize("angle", [65.0, 0.0, -1.0, np.pi])
@pytest.mark.parametrize("name", ["camera_angle_x", "camera_angle_y"])
def test_an_angle_of_view_in_degrees_is_refused(name: str, angle: float, tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 1)
    write_transforms(tmp_path, [{}], **({"camera_angle_x": 1.0} | {name: angle}))
    with pytest.raises(BadFileError, match=rf"{name} = .* no angle of view between 0 and pi: write it in radians"):
        open_dataset("images", path=tmp_path)


def test_a_principal_point_of_other_images_is_doubted_once(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    write_transforms(tmp_path, [{}] * 3, fl_x=100.0, cx=64.0, cy=48.0)
    (told,) = open_dataset("images", path=tmp_path).warnings
    assert told.startswith(
        "transforms.json: the principal point cx, cy = 63.5, 47.5 lies at the border of images of 64x48"
    )
    write_transforms(tmp_path, [{}] * 3, fl_x=100.0, cx=64.0, cy=48.0, w=128, h=96)
    assert open_dataset("images", path=tmp_path).warnings == [], "scaled to the images"
    (tmp_path / "transforms.json").unlink()
    colmap_text(tmp_path / "sparse/0", [f"photo{i}.png" for i in range(3)])
    assert open_dataset("images", path=tmp_path).warnings == []
    (tmp_path / "sparse/0/cameras.txt").write_text("1 PINHOLE 64 48 50 51 24 32\n")
    (told,) = open_dataset("images", path=tmp_path).warnings
    assert told.startswith("COLMAP model: the principal point cx, cy = 23.5, 31.5 is that of images of 48x64")


def test_the_angle_of_view_of_a_frame_counts_before_the_focal_length_of_all(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 2)
    write_transforms(tmp_path, [{"camera_angle_x": np.pi / 2}, {}], fl_x=50.0, fl_y=51.0)
    focal = [item.intrinsics[:2].tolist() for item in open_dataset("images", path=tmp_path)]
    assert focal == [pytest.approx([32.0, 32.0]), [50.0, 51.0]]
