"""KITTI's raw recordings and TartanAir: layout, units and conventions."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from tests.support.slam_folders import write_kitti_raw, write_tartanair


def test_kitti_raw(tmp_path: Path) -> None:
    sequence = open_dataset("kitti_raw", path=write_kitti_raw(tmp_path))
    items = list(sequence)
    assert sequence.warnings == []
    assert [int(item.image[0, 0, 0]) for item in items] == [20, 22, 23]
    assert items[1].timestamp - items[0].timestamp == pytest.approx(0.2, abs=1e-5)
    for east, item in zip((0, 200, 300), items):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 31, 23])
        assert item.world_from_cam is not None
        # forward is east, right south, down down; 1 m above the unit, and .06 m to the left of the gray camera
        right, down, forward = item.world_from_cam[:3, :3].T
        np.testing.assert_allclose([right, down, forward], [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(item.world_from_cam[:3, 3], [east, 0.06, 1.0], atol=1e-6)


def test_kitti_raw_with_less(tmp_path: Path) -> None:
    folder = write_kitti_raw(tmp_path)
    (folder / "oxts/data/0000000002.txt").unlink()
    sequence = open_dataset("kitti_raw", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [True, False, True]
    assert sequence.warnings == ["1 of 3 images have no true pose"]
    (folder.parent / "calib_imu_to_velo.txt").rename(folder / "calib_imu_to_velo.txt")  # where it can also lie
    assert next(iter(open_dataset("kitti_raw", path=folder))).world_from_cam is not None
    (folder / "calib_imu_to_velo.txt").unlink()
    sequence = open_dataset("kitti_raw", path=folder)
    assert all(item.world_from_cam is None for item in sequence)
    assert [w.rpartition(" is missing")[2] for w in sequence.warnings] == [": the trajectory is not scored"]
    (folder.parent / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"calib_cam_to_cam\.txt is missing; KITTI raw"):
        open_dataset("kitti_raw", path=folder)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("../calib_cam_to_cam.txt", "P_rect_02: 50 0 31 3 0 51 23 0 0 0 1 0"),  # without R_rect_00
        ("../calib_cam_to_cam.txt", "P_rect_02: 1 2 3"),
        ("../calib_cam_to_cam.txt", "P_rect_02: 50 0 31 3 0 51 23 0 0 0 1 0\nS_rect_02: 64"),
        ("../calib_velo_to_cam.txt", "R: 1 2 3"),
        ("../calib_velo_to_cam.txt", "R: 1 1 1 1 1 1 1 1 1\nT: 0 0 0"), ("image_02/timestamps.txt", "yesterday"),
        ("image_02/timestamps.txt", "2011-09-26 13:02:25.5"), ("oxts/data/0000000000.txt", "1 2 3"),
        ("oxts/data/0000000000.txt", "nan " * 30), ("oxts/data/0000000000.txt", "90 " * 30),
    ],
)  # fmt: skip
def test_a_damaged_file_of_kitti_raw_is_named(name: str, content: str, tmp_path: Path) -> None:
    folder = write_kitti_raw(tmp_path)
    (folder / name).write_text(content)
    with pytest.raises(BadFileError, match=Path(name).name):
        open_dataset("kitti_raw", path=folder)


def test_drives_that_are_not_rectified_are_refused(tmp_path: Path) -> None:
    folder = write_kitti_raw(tmp_path)
    calibration = folder.parent / "calib_cam_to_cam.txt"
    text = calibration.read_text()
    calibration.write_text(text + "S_rect_02: 6.400000e+01 4.800000e+01\n")
    assert len(open_dataset("kitti_raw", path=folder)) == 3
    calibration.write_text(text + "S_rect_02: 6.000000e+01 4.000000e+01\n")
    with pytest.raises(ValueError, match=r"of 64x48, and calib_cam_to_cam\.txt is for .* 60x40: take .*synced\+rect"):
        open_dataset("kitti_raw", path=folder)


@pytest.mark.parametrize("camera", ["left", "lcam_front"])
def test_tartanair(camera: str, tmp_path: Path) -> None:
    sequence = open_dataset("tartanair", path=write_tartanair(tmp_path, camera))
    items = list(sequence)
    assert sequence.warnings == []
    assert [int(item.image[0, 0, 0]) for item in items] == [20, 21, 22]
    for i, item in enumerate(items):
        np.testing.assert_allclose(item.intrinsics, [32, 32, 31.5, 23.5])  # 90 degrees across
        assert item.timestamp == pytest.approx(i / 10)
        assert item.world_from_cam is not None
        assert item.depth is not None
        assert np.unique(item.depth[1:]).tolist() == [2.0]
        assert not item.depth[0].any()  # the sky has none
        np.testing.assert_allclose(item.world_from_cam[:3, 3], [i, 0, -2])
        forward = [0, 1, 0] if i == 2 else [1, 0, 0]  # north, east, down
        np.testing.assert_allclose(item.world_from_cam[:3, 2], forward, atol=1e-12)
        np.testing.assert_allclose(item.world_from_cam[:3, 1], [0, 0, 1], atol=1e-12)


def test_tartanair_with_less_and_with_damage(tmp_path: Path) -> None:
    folder = write_tartanair(tmp_path)
    (folder / "depth_left/000001_left_depth.npy").write_bytes(b"\x93NUMPY" + bytes(40))
    (folder / "depth_left/000002_left_depth.npy").unlink()
    os.mkfifo(folder / "depth_left/000002_left_depth.npy")  # is not waited for
    sequence = open_dataset("tartanair", path=folder)
    assert [item.depth is not None for item in sequence] == [True, False, False]
    assert any("depth maps that could not be read" in w and "2 " in w for w in sequence.warnings)
    poses = folder / "pose_left.txt"
    whole = poses.read_text()
    for bad in ("1 2 3", whole.replace("0 0 -2", "0 0 nan", 1), "0 0 0 0 0 0 0\n" + whole):
        poses.write_text(bad)
        with pytest.raises(BadFileError, match=r"pose_left\.txt"):
            open_dataset("tartanair", path=folder)
    poses.write_text(7 * "0 0 -2 0 0 0 1 0\n")
    with pytest.raises(BadFileError, match=r"7 numbers, x y z qx qy qz qw; line 1 has 8"):
        open_dataset("tartanair", path=folder)
    poses.write_text(whole.splitlines()[0])
    assert open_dataset("tartanair", path=folder).warnings == ["2 of 3 images have no true pose"]
    poses.unlink()
    assert any("is missing: the trajectory is not scored" in w for w in open_dataset("tartanair", path=folder).warnings)
    with pytest.raises(FileNotFoundError, match="image_right is missing; TartanAir"):
        open_dataset("tartanair", path=folder, camera="right")
