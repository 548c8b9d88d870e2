"""EuRoC, TUM VI, KITTI odometry, ScanNet and ETH3D: layout, units and conventions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.lens import Lens
from tests.support.dataset_folders import pose, write_depth, write_image, write_tum
from tests.support.slam_folders import DRIFTS, write_euroc, write_kitti, write_kitti_raw, write_scannet, write_tum_vi


def test_euroc(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "V1_01_easy")
    for path in (folder, folder / "mav0"):
        sequence = open_dataset("euroc", path=path)
        items = list(sequence)
        assert [int(item.image[0, 0, 0]) for item in items] == [20, 21, 22, 23, 24]
        for i, item in enumerate(items):
            assert item.timestamp == pytest.approx(1403636579.763555584 + i / 20, abs=1e-6)
            np.testing.assert_allclose(item.world_from_cam, pose(i), atol=1e-5)  # a camera's, not the body's
        assert sequence.warnings == []
    bent = Lens((40.0, 40.0, 31.5, 23.5), (48, 64), (-0.28, 0.07, 0.0002, 0.00002))
    assert open_dataset("euroc", path=folder).lens == bent
    assert items[0].image.min() == 20, "undistorted, without an empty border"


def test_the_other_camera_of_euroc(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"cam1.data\.csv is missing; EuRoC"):
        open_dataset("euroc", path=folder, camera=1)
    write_euroc(tmp_path, camera=1)
    assert len(open_dataset("euroc", path=folder, camera=1)) == 5


def test_euroc_without_its_calibration(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    (folder / "mav0/cam0/sensor.yaml").unlink()
    with pytest.raises(FileNotFoundError, match=r"sensor\.yaml is missing: copy it, or set dataset\.intrinsics"):
        open_dataset("euroc", path=folder)
    given = open_dataset("euroc", path=folder, intrinsics=[40, 40, 31.5, 23.5])
    assert given.warnings == ["where the camera is on the body is not known: the trajectory is not scored"]
    assert next(iter(given)).world_from_cam is None


def test_euroc_whose_truth_begins_late_or_is_missing(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    truth = folder / "mav0/state_groundtruth_estimate0/data.csv"
    lines = truth.read_text().splitlines()
    late = [line for line in lines[1:] if int(line.split(",")[0]) > 1403636579863000000]
    truth.write_text("\n".join([lines[0], *late]))
    sequence = open_dataset("euroc", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [False, False, True, True, True]
    assert sequence.warnings == ["2 of 5 images have no true pose within 0.02 s"]
    truth.write_text("#timestamp\n")
    assert any("is empty: the trajectory is not scored" in w for w in open_dataset("euroc", path=folder).warnings)
    truth.unlink()
    assert any("has no state_groundtruth_estimate0 or mocap0" in w for w in open_dataset("euroc", path=folder).warnings)


def test_tum_vi(tmp_path: Path) -> None:
    """Kalibr's file has the body as the camera sees it, its lens is a fisheye, its images have 16 bits."""
    sequence = open_dataset("euroc", path=write_tum_vi(tmp_path / "dataset-room1_512_16"))
    items = list(sequence)
    assert sequence.lens == Lens((30.0, 30.0, 31.5, 23.5), (48, 64), (0.003, 0.0007, -0.002, 0.0002), fisheye=True)
    assert [int(item.image[24, 32, 0]) for item in items] == [20, 21, 22, 23, 24]
    for i, item in enumerate(items):
        np.testing.assert_allclose(item.world_from_cam, pose(i), atol=1e-5)


@pytest.mark.parametrize(
    "damage",
    [
        ("mav0/cam0/data.csv", "x,1.png"), ("mav0/cam0/data.csv", "1"), ("mav0/cam0/data.csv", "9" * 40 + ",1.png"),
        ("mav0/cam0/data.csv", "5,../../../secret.png"),
        ("mav0/cam0/sensor.yaml", "["), ("mav0/cam0/sensor.yaml", "resolution: [64, 48]"),
        ("mav0/cam0/sensor.yaml", ""), ("mav0/cam0/sensor.yaml", "[" * 5000),
        ("mav0/state_groundtruth_estimate0/data.csv", "1,2,3"),
        ("mav0/state_groundtruth_estimate0/data.csv", "1,a,3,4,1,0,0,0"),
    ],
)  # fmt: skip
def test_damaged_files_of_euroc_are_named(tmp_path: Path, damage: tuple[str, str]) -> None:
    folder = write_euroc(tmp_path)
    (folder / damage[0]).write_text(damage[1])
    with pytest.raises(BadFileError, match=Path(damage[0]).name):
        open_dataset("euroc", path=folder)


def test_the_given_lens_replaces_one_of_euroc_that_is_not_read(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path)
    file = folder / "mav0/cam0/sensor.yaml"
    file.write_text(file.read_text().replace("pinhole", "ds"))
    with pytest.raises(BadFileError, match=r"set dataset\.intrinsics and dataset\.distortion"):
        open_dataset("euroc", path=folder)
    given = open_dataset("euroc", path=folder, intrinsics=[40, 40, 31.5, 23.5], distortion=["fisheye", 0.01, 0, 0, 0])
    assert given.lens == Lens((40.0, 40.0, 31.5, 23.5), (48, 64), (0.01, 0.0, 0.0, 0.0), fisheye=True)
    for i, item in enumerate(given):
        np.testing.assert_allclose(item.world_from_cam, pose(i), atol=1e-5)


@pytest.mark.parametrize(
    "change", [("pinhole", "omni"), ("radial-tangential", "fov"), ("T_BS", "T_SB"), ("1.0", ".nan")]
)
def test_cameras_of_euroc_that_are_not_read(tmp_path: Path, change: tuple[str, str]) -> None:
    folder = write_euroc(tmp_path)
    file = folder / "mav0/cam0/sensor.yaml"
    file.write_text(file.read_text().replace(*change))
    with pytest.raises(BadFileError, match=r"sensor\.yaml is no calibration that can be used"):
        open_dataset("euroc", path=folder)


def test_kitti(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    sequence = open_dataset("kitti", path=folder)
    items = list(sequence)
    assert sequence.warnings == []
    assert [int(item.image[0, 0, 0]) for item in items] == [20, 21, 22, 23]
    for i, item in enumerate(items):
        assert item.timestamp == pytest.approx(0.104 * i)
        np.testing.assert_allclose(item.intrinsics, [50, 51, 31, 23])
        np.testing.assert_allclose(item.world_from_cam, pose(i) @ DRIFTS)  # of the color camera, beside the gray one
    gray = list(open_dataset("kitti", path=folder, camera=0))
    assert int(gray[1].image[0, 0, 0]) == 121
    np.testing.assert_allclose(gray[3].world_from_cam, pose(3))
    with pytest.raises(FileNotFoundError, match="image_3 is missing; KITTI"):
        open_dataset("kitti", path=folder, camera=3)


def test_kitti_with_less(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    truth = tmp_path / "poses/07.txt"
    truth.write_text("\n".join(truth.read_text().splitlines()[:3]).replace("1.0", "nan", 1))
    sequence = open_dataset("kitti", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [False, True, True, False]
    assert sequence.warnings == ["2 of 4 images have no true pose"]
    truth.rename(folder / "poses.txt")  # where it can also lie
    assert next(iter(open_dataset("kitti", path=folder, start=1))).world_from_cam is not None
    (folder / "poses.txt").unlink()
    (folder / "times.txt").unlink()
    sequence = open_dataset("kitti", path=folder)
    assert [item.timestamp for item in sequence] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert [w.rpartition(" is missing")[2] for w in sequence.warnings] == [
        ": frames are taken to come at 10 a second", ": the trajectory is not scored",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "damage",
    [
        ("calib.txt", "P0: 1 2 3"), ("calib.txt", "P2: " + "nan " * 12), ("calib.txt", "P2: " + "1 " * 12),
        ("times.txt", "0 1 x"), ("times.txt", "0 2 1 3"), ("times.txt", "0 nan"), ("times.txt", "0 1 2"),
        ("poses.txt", "1 2 3"), ("poses.txt", 3 * ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")),
    ],
)  # fmt: skip
def test_damaged_files_of_kitti_are_named(tmp_path: Path, damage: tuple[str, str]) -> None:
    folder = write_kitti(tmp_path)
    (folder / damage[0]).write_text(damage[1])
    with pytest.raises(BadFileError, match=damage[0]):
        open_dataset("kitti", path=folder)


def test_scannet(tmp_path: Path) -> None:
    folder = write_scannet(tmp_path / "scene0000_00")
    sequence = open_dataset("scannet", path=folder)
    items = list(sequence)
    assert [int(item.image[0, 0, 0]) for item in items] == list(range(20, 32)), "2.jpg before 10.jpg"
    assert items[3].timestamp == pytest.approx(0.1)
    np.testing.assert_allclose(items[0].intrinsics, [200, 200, 127.5, 95.5])
    np.testing.assert_array_equal(items[2].world_from_cam, pose(2))
    assert items[1].world_from_cam is None
    assert sequence.warnings[0] == "1 of 12 images have no true pose"
    depth = items[0].depth
    assert depth is not None
    assert depth.shape == (192, 256)
    assert depth[96, 128] == pytest.approx(2.0)
    assert depth[60, 80] == pytest.approx(2.0), "nearer to the middle, as the color camera's field of view is wider"
    assert depth[4, 4] == 0.0, "the depth camera saw nothing there"


def test_scannet_without_depth_or_its_camera(tmp_path: Path) -> None:
    folder = write_scannet(tmp_path)
    (folder / "intrinsic/intrinsic_depth.txt").unlink()
    sequence = open_dataset("scannet", path=folder)
    assert any("depth maps are taken to be the color camera's" in w for w in sequence.warnings)
    depth = next(iter(sequence)).depth
    assert depth is not None
    assert (depth == 2.0).all()
    for path in (folder / "depth").iterdir():
        path.unlink()
    assert next(iter(open_dataset("scannet", path=folder))).depth is None
    for path in (folder / "pose").iterdir():
        path.unlink()
    assert any("has no pose of an image" in w for w in open_dataset("scannet", path=folder).warnings)
    (folder / "intrinsic/intrinsic_color.txt").write_text("1 2 3")
    with pytest.raises(BadFileError, match=r"intrinsic_color\.txt must hold a 4x4"):
        open_dataset("scannet", path=folder)
    (folder / "intrinsic/intrinsic_color.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"intrinsic_color\.txt is missing; ScanNet"):
        open_dataset("scannet", path=folder)


def test_eth3d_has_its_camera_in_a_file(tmp_path: Path) -> None:
    """Its SLAM benchmark has TUM's layout, with calibration.txt."""
    folder = write_tum(tmp_path / "cables_1")
    (folder / "calibration.txt").write_text("60 61 32 24\n")
    np.testing.assert_allclose(next(iter(open_dataset("tum", path=folder))).intrinsics, [60, 61, 32, 24])


def test_images_that_were_scaled_after_their_calibration(tmp_path: Path) -> None:
    folder = write_scannet(tmp_path / "scannet", 2)
    for i in range(2):
        write_image(folder / f"color/{i}.png", 20 + i, (96, 128))
    with pytest.raises(BadFileError, match=r"intrinsic_color\.txt: .* \(about 256x192\) .*; export .*dataset\.intr"):
        open_dataset("scannet", path=folder)
    given = open_dataset("scannet", path=folder, intrinsics=[100, 100, 63.5, 47.5])
    assert not any("border" in w for w in given.warnings)
    for i in range(2):
        write_image(folder / f"color/{i}.png", 20 + i, (192, 256))
        write_depth(folder / f"depth/{i}.png", 2000, (48, 64))
    with pytest.raises(BadFileError, match=r"intrinsic_depth\.txt: .*export depth maps as they are"):
        open_dataset("scannet", path=folder)
    drive = write_kitti(tmp_path / "kitti")
    for i in range(4):
        write_image(drive / f"image_2/{i:06d}.png", 20 + i, (24, 32))
    assert any("of another size (about 63x47)" in w for w in open_dataset("kitti", path=drive).warnings)
    own = open_dataset("kitti", path=drive, intrinsics=[25, 25, 15.5, 11.5])
    assert not any("border" in w for w in own.warnings)


def test_the_mark_that_windows_puts_before_a_text(tmp_path: Path) -> None:
    folder, drive = write_euroc(tmp_path / "euroc"), write_kitti(tmp_path / "kitti")
    raw = write_kitti_raw(tmp_path / "raw")
    cam, calibrations = folder / "mav0/cam0", raw.parent.glob("calib_*.txt")
    for file in (cam / "data.csv", cam / "sensor.yaml", drive / "times.txt", raw / "image_02/timestamps.txt",
                 *calibrations):  # fmt: skip
        file.write_text(file.read_text(), encoding="utf-8-sig")
    calibration = (drive / "calib.txt").read_text()
    (drive / "calib.txt").write_text(calibration[calibration.index("P2") :], encoding="utf-8-sig")
    assert len(open_dataset("euroc", path=folder)) == 5
    assert len(open_dataset("kitti", path=drive)) == 4
    assert len(open_dataset("kitti_raw", path=raw)) == 3
