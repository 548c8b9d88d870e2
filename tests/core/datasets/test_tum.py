"""TUM RGB-D layout: which camera, association by time, and what is missing."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.by_time import nearest
from mvsgs_core.datasets.tum import CAMERAS
from mvsgs_core.datasets.write_tum import main
from mvsgs_core.geometry import quaternion_from_rotation, so3_exp
from mvsgs_core.trajectory_file import read_trajectory
from tests.support.dataset_folders import pose, truncate, write_image, write_tum
from tests.support.full_disk import full_after


def test_frames_poses_and_depth_are_associated(tmp_path: Path) -> None:
    sequence = open_dataset("tum", path=write_tum(tmp_path / "rgbd_dataset_freiburg3_x"))
    items = list(sequence)
    assert len(sequence) == len(items) == 5
    assert [item.index for item in items] == [0, 1, 2, 3, 4]
    assert [item.image[0, 0, 0] for item in items] == [20, 21, 22, 23, 24]
    for i, item in enumerate(items):
        assert item.timestamp == pytest.approx(i / 10)
        assert item.world_from_cam is not None
        np.testing.assert_allclose(item.world_from_cam, pose(i), atol=1e-9)
        assert (item.depth is not None) == (i % 2 == 0)
    assert items[0].depth is not None
    assert items[0].depth.dtype == np.float32
    np.testing.assert_allclose(items[0].depth, 2.0)
    assert sequence.warnings == ["frames without a depth map, where depth is not scored: 2 (first: 1.png)"]


def test_times_that_do_not_ascend_are_said(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 12)
    (folder / "rgb.txt").write_text("".join(f"1.0 rgb/{i}.png\n" for i in range(12)))
    sequence = open_dataset("tum", path=folder)
    assert [item.image[0, 0, 0] for item in sequence] == list(range(20, 32)), "in the order of the list"
    told = "frames whose time is not after that of the frame before: 11 (first: 1.png, 1.000000 s); they are taken in "
    assert any(warning.startswith(told) for warning in sequence.warnings)


def test_selection(tmp_path: Path) -> None:
    sequence = open_dataset("tum", path=write_tum(tmp_path / "fr3", 9), start=1, stop=8, stride=3)
    assert len(sequence) == 3
    assert [(item.index, item.image[0, 0, 0]) for item in sequence] == [(0, 21), (1, 24), (2, 27)]
    with pytest.raises(ValueError, match="no frame left"):
        open_dataset("tum", path=tmp_path / "fr3", start=9)
    with pytest.raises(ValueError, match="stride >= 1"):
        open_dataset("tum", path=tmp_path / "fr3", stride=0)


@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg1_xyz", "tum_fr2_desk", "freiburg3"])
def test_camera_from_the_folder_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    write_tum(folder)
    for i in range(5):
        write_image(folder / f"rgb/{i}.png", 20, (480, 640))
    item = next(iter(open_dataset("tum", path=folder)))
    published = CAMERAS["freiburg" + next(c for c in name if c.isdigit())]
    np.testing.assert_allclose(item.intrinsics[2:], published.intrinsics[2:])
    zoom = item.intrinsics[:2] / published.intrinsics[:2]
    assert zoom[0] == pytest.approx(zoom[1])
    assert 1.0 <= zoom[0] < 1.1
    assert item.image.min() == 20  # the zoom leaves no empty border


def test_camera_from_the_trajectory_header(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "sequence")
    (folder / "groundtruth.txt").write_text("# file: 'rgbd_dataset_freiburg3_office.bag'\n0 0 0 0 0 0 0 1\n")
    item = next(iter(open_dataset("tum", path=folder)))
    assert item.intrinsics[0] == pytest.approx(535.4 * 64 / 640)


def test_unknown_camera_lists_what_to_do(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "sequence")
    with pytest.raises(ValueError, match=r"freiburg1, freiburg2, freiburg3.*intrinsics"):
        open_dataset("tum", path=folder)
    with pytest.raises(ValueError, match="camera is one of"):
        open_dataset("tum", path=folder, camera="kinect")
    given = next(iter(open_dataset("tum", path=folder, intrinsics=[50, 51, 31, 23])))
    np.testing.assert_allclose(given.intrinsics, [50, 51, 31, 23])
    (folder / "camera.txt").write_text("60 61 32 24 0 0 0 0\n")
    from_file = next(iter(open_dataset("tum", path=folder)))
    np.testing.assert_allclose(from_file.intrinsics, [60, 61, 32, 24])


def test_published_protocol_keeps_the_focal_length(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1")
    write_image(folder / "rgb/0.png", 99, (480, 640))
    item = next(iter(open_dataset("tum", path=folder, size=(384, 512), crop=8)))
    assert item.image.shape == (384, 512, 3)
    sx, sy = 528 / 640, 400 / 480
    np.testing.assert_allclose(
        item.intrinsics, [517.3 * sx, 516.5 * sy, 319.1 * sx - 0.5 - 8, 255.8 * sy - 0.5 - 8], atol=1e-9
    )


def test_a_depth_map_goes_to_one_image_only(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3")
    items = list(open_dataset("tum", path=folder, max_difference=0.15))  # odd frames are nearer than this to a depth
    assert [item.depth is not None for item in items] == [True, False, True, False, True]


def test_nearest() -> None:
    times = np.array([0.0, 1.0, 2.0])
    assert nearest(np.array([-0.3, 0.4, 0.6, 1.5, 2.4, 9.0]), times, 0.45) == {0: 0, 1: 0, 2: 1, 4: 2}
    assert nearest(np.array([0.1]), np.array([0.0]), 0.5) == {0: 0}
    assert nearest(np.array([0.1]), np.array([]), 0.5) == {}


@pytest.mark.parametrize("content", ["", "# only a comment\n\n"])
def test_empty_ground_truth(tmp_path: Path, content: str) -> None:
    folder = write_tum(tmp_path / "fr3")
    (folder / "groundtruth.txt").write_text(content)
    sequence = open_dataset("tum", path=folder)
    assert all(item.world_from_cam is None for item in sequence)
    assert "groundtruth.txt is empty: the trajectory is not scored" in sequence.warnings
    (folder / "groundtruth.txt").unlink()
    assert "groundtruth.txt is missing: the trajectory is not scored" in open_dataset("tum", path=folder).warnings


def test_gaps_in_the_ground_truth(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3")
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 0\n")
    sequence = open_dataset("tum", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [True, True, False, False, False]
    assert "3 of 5 images have no true pose within 0.02 s" in sequence.warnings


@pytest.mark.parametrize("line", ["0 1 2 3", "0 1 2 x 0 0 0 1"])
def test_malformed_trajectory_names_the_line(tmp_path: Path, line: str) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text(line)
    with pytest.raises(ValueError, match=line):
        read_trajectory(path)


def test_broken_files_are_left_out_and_it_goes_on(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 6)
    truncate(folder / "rgb/1.png")
    (folder / "rgb/3.png").unlink()
    (folder / "rgb/5.png").write_bytes(b"no image at all")
    truncate(folder / "depth/0.png")
    (folder / "depth/2.png").unlink()
    sequence = open_dataset("tum", path=folder)
    for _ in range(2):  # a second pass gives the same and counts anew
        items = list(sequence)
        assert [(item.index, item.image[0, 0, 0], item.depth is not None) for item in items] == [
            (0, 20, False), (1, 22, False), (2, 24, True),
        ]  # fmt: skip
        assert len(sequence.warnings) == 3
        unread = next(w for w in sequence.warnings if w.startswith("images left out because they could not be read: 3"))
        assert "1.png" in unread
        assert any(w.startswith("depth maps that could not be read") and "0.png" in w for w in sequence.warnings)
        assert any(w.startswith("frames without a depth map, where depth is not scored: 1") for w in sequence.warnings)


def test_nothing_readable_is_an_error(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 2)
    for path in (folder / "rgb").iterdir():
        truncate(path)
    with pytest.raises(ValueError, match="no image could be read"):
        list(open_dataset("tum", path=folder))


def test_a_missing_path_says_layout_and_source(tmp_path: Path) -> None:
    for path in (None, tmp_path / "nowhere", tmp_path):
        with pytest.raises(FileNotFoundError, match=r"rgb\.txt(.|\n)*cvg\.cit\.tum\.de"):
            open_dataset("tum", path=path)


def test_a_pose_between_two_of_motion_capture_is_interpolated(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3")  # images at 0, 0.1, ...
    rows = ["0.096 1 0 0 0 0 0 1", "0.106 2 0 0 0 0 0 1", "0.196 5 0 0 0 0 0 1", "0.5 9 0 0 0 0 0 1"]
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    items = list(open_dataset("tum", path=folder))
    assert items[0].world_from_cam is None
    for item, x in ((items[1], 1.4), (items[2], 5.0)):  # the second one's other neighbor is too far away
        assert item.world_from_cam is not None
        assert item.world_from_cam[0, 3] == pytest.approx(x)


def test_bonn_has_poses_of_the_markers_on_its_camera(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "rgbd_bonn_balloon")
    turned = so3_exp(np.array([0.2, -0.4, 0.1]))
    w, x, y, z = quaternion_from_rotation(turned)
    (folder / "groundtruth.txt").write_text(f"0 1 2 3 {x} {y} {z} {w}\n")
    (folder / "depth.txt").unlink()
    items = list(open_dataset("tum", path=folder))
    assert items[0].world_from_cam is not None
    # world and markers, in axes of ROS there
    swap = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    world_from_markers = swap @ turned @ swap
    np.testing.assert_allclose(
        items[0].world_from_cam[:3, 3], swap @ [1, 2, 3] + world_from_markers @ [0.0113, -0.0098, 0.0111], atol=1e-6
    )
    rotation = items[0].world_from_cam[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    published = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    np.testing.assert_allclose(world_from_markers.T @ rotation, published / 1.0593, atol=1e-3)
    assert open_dataset("tum", path=folder).lens == CAMERAS["bonn"]
    given = open_dataset("tum", path=folder, intrinsics=[50, 51, 31, 23])  # poses stay the markers'
    np.testing.assert_allclose(next(iter(given)).world_from_cam, items[0].world_from_cam)
    folder.rename(tmp_path / "balloon")
    named = open_dataset("tum", path=tmp_path / "balloon", camera="bonn")
    np.testing.assert_allclose(next(iter(named)).world_from_cam, items[0].world_from_cam)


def test_comments_and_the_mark_that_windows_puts_before_a_text(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "x")
    for name in ("rgb.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(line for line in lines if line[0] != "#"), encoding="utf-8-sig")
    (folder / "camera.txt").write_text("# fx fy cx cy\n60 61 32 24  # no distortion\n", encoding="utf-8-sig")
    items = list(open_dataset("tum", path=folder))
    np.testing.assert_allclose(items[0].intrinsics, [60, 61, 32, 24])
    assert [item.world_from_cam is not None for item in items] == [True] * 5
    (folder / "camera.txt").write_text("60 61 32 24", encoding="utf-8-sig")
    np.testing.assert_allclose(next(iter(open_dataset("tum", path=folder))).intrinsics, [60, 61, 32, 24])


def test_intrinsics_of_images_of_another_size_are_told_of(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "x")
    told = r"cx, cy = 63, 47 lies at the border of images of 64x48 .* another size \(about 127x95\)"
    (folder / "camera.txt").write_text("120 122 63 47\n")
    for options in ({}, {"intrinsics": [120, 122, 63, 47]}):
        assert any(re.search(told, w) for w in open_dataset("tum", path=folder, **options).warnings)
    cropped = open_dataset("tum", path=folder, intrinsics=[60, 61, -5, 24])
    assert any("lies at the border" in w and "about" not in w for w in cropped.warnings)
    assert not any("border" in w for w in open_dataset("tum", path=folder, intrinsics=[60, 61, 50, 24]).warnings)


@pytest.mark.parametrize("what", ["rgb/0.000000.png", "groundtruth.txt"])
def test_a_recording_that_finds_no_room_on_the_disk_is_said_not_to_be_whole(tmp_path: Path, what: str) -> None:
    """Also where it is the last byte of a file that finds none. Once there is room, the same command writes it."""
    folder = tmp_path / "walk"
    size, frames = ("48", "64"), "1"
    if what == "groundtruth.txt":
        size, frames = ("12", "12"), "20"
    command = [str(folder), "--frames", frames, "--size", *size]
    main(command)
    room = (folder / what).stat().st_size - 1
    assert max(path.stat().st_size for path in folder.rglob("*") if path.is_file()) == room + 1
    shutil.rmtree(folder)
    with full_after(room), pytest.raises(SystemExit, match=f"^write_tum: {folder} is not whole: .*File too large"):
        main(command)
    main(command)
    assert len(list(open_dataset("tum", path=folder))) == int(frames)
