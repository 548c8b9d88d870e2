"""Replica, 7-Scenes and ICL-NUIM: layout, units and conventions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.datasets import formats, open_dataset
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.registration import register
from tests.support.dataset_folders import (
    pose,
    write_depth,
    write_icl_nuim,
    write_image,
    write_replica,
    write_seven_scenes,
    write_tum,
)


def test_replica(tmp_path: Path) -> None:
    folder = write_replica(tmp_path / "room0")
    items = list(open_dataset("replica", path=folder))
    assert [item.image[0, 0, 0] for item in items] == [20, 21, 22, 23]
    for i, item in enumerate(items):
        np.testing.assert_array_equal(item.world_from_cam, pose(i))
        np.testing.assert_allclose(item.depth, 2.0)
        np.testing.assert_allclose(item.intrinsics, [60, 60, 59.5, 33.5])  # published ones, at a tenth of the size
    (tmp_path / "cam_params.json").write_text(
        '{"camera": {"w": 120, "h": 68, "fx": 77, "fy": 78, "cx": 60, "cy": 34, "scale": 1310.7}}'
    )
    item = next(iter(open_dataset("replica", path=folder)))
    np.testing.assert_allclose(item.intrinsics, [77, 78, 60, 34])
    np.testing.assert_allclose(item.depth, 10.0)
    (tmp_path / "cam_params.json").write_text('{"camera": {"w": 120}}')
    with pytest.raises(ValueError, match=r"cam_params.json must hold"):
        open_dataset("replica", path=folder)


def test_replica_without_all_its_poses(tmp_path: Path) -> None:
    folder = write_replica(tmp_path / "room0")
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join([lines[0], lines[1].replace("1.0", "nan", 1)]))
    sequence = open_dataset("replica", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [True, False, False, False]
    assert sequence.warnings == ["traj.txt has no pose for 3 of 4 frames"]
    (folder / "traj.txt").write_text("")
    assert open_dataset("replica", path=folder).warnings == ["traj.txt is empty: the trajectory is not scored"]
    for bad in ("1 2 3", 4 * "1 0 0 0 0 1 0 0 0 0 1 0\n"):
        (folder / "traj.txt").write_text(bad)
        with pytest.raises(ValueError, match=r"16 numbers, a 4x4 camera to world; line 1 has (3|12)"):
            open_dataset("replica", path=folder)


def test_seven_scenes(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path)
    for path in (folder, folder / "seq-01"):
        items = list(open_dataset("seven_scenes", path=path))
        assert len(items) == 4
        np.testing.assert_allclose(items[0].intrinsics, [525, 525, 320, 240])
        assert items[0].depth is not None
        assert items[0].depth[240, 320] == pytest.approx(2.0)
        assert items[1].depth is not None
        assert not items[1].depth.any()  # 65535 means unknown
        assert items[2].timestamp == pytest.approx(2 / 30)
        # the color camera stands a little to the right of the depth camera, whose poses the files have
        np.testing.assert_allclose(items[2].world_from_cam, pose(2) + 0.021 * np.eye(4, k=3))
    published = list(open_dataset("seven_scenes", path=folder, registered=False))
    np.testing.assert_allclose(published[0].intrinsics, [585, 585, 320, 240])
    np.testing.assert_array_equal(published[2].world_from_cam, pose(2))
    with pytest.raises(FileNotFoundError, match="seq-07 is missing"):
        open_dataset("seven_scenes", path=folder, sequence="seq-07")


def test_seven_scenes_lost_poses(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path)
    (folder / "seq-01/frame-000001.pose.txt").write_text("-1.#IND " * 16)
    (folder / "seq-01/frame-000002.pose.txt").unlink()
    sequence = open_dataset("seven_scenes", path=folder)
    assert [item.world_from_cam is not None for item in sequence] == [True, False, False, True]
    assert sequence.warnings == ["2 of 4 frames have no true pose (first: frame-000001)"]


def test_registration_moves_near_surfaces_further_and_keeps_the_nearest() -> None:
    lens = Lens((100.0, 100.0, 50.0, 20.0), (40, 100))
    depth = np.zeros((40, 100), dtype=np.float32)
    depth[20, 50] = 10.0
    depth[10, 60] = 1.0
    depth[30, 55], depth[30, 52] = 1.0, 2.5  # both land on one pixel
    moved = register(depth, lens, lens, 0.05)
    assert moved[20, 50] == pytest.approx(10.0)  # half a pixel, rounded to even
    assert moved[10, 55] == pytest.approx(1.0)
    assert moved[30, 50] == pytest.approx(1.0)
    assert np.count_nonzero(moved) == 3


def test_icl_nuim(tmp_path: Path) -> None:
    sequence = open_dataset("icl_nuim", path=write_icl_nuim(tmp_path))
    items = list(sequence)
    assert [int(item.image[0, 0, 0]) for item in items] == list(range(20, 32))  # 2.png before 10.png
    assert items[0].world_from_cam is None
    assert "1 of 12 images have no true pose" in sequence.warnings
    third = items[3].world_from_cam
    assert third is not None
    np.testing.assert_allclose(third[:3, 3], [3, -7, 0])  # y turned down, in the world too
    assert np.linalg.det(third[:3, :3]) == pytest.approx(1.0)
    assert items[3].intrinsics[1] > 0
    np.testing.assert_allclose(items[3].depth, 2.0)


def test_hidden_files_of_another_disk_are_no_poses(tmp_path: Path) -> None:
    folder = write_icl_nuim(tmp_path, 3)
    (folder / "groundtruth.txt").rename(folder / "livingRoom0.gt.freiburg")
    (folder / "._livingRoom0.gt.freiburg").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert [item.world_from_cam is not None for item in open_dataset("icl_nuim", path=folder)] == [False, True, True]


def test_noise_where_nothing_is_known_is_no_depth(tmp_path: Path) -> None:
    """The noisy variant's maps have 1 to 3 centimeters there."""
    folder = write_icl_nuim(tmp_path, 2)
    write_depth(folder / "depth/1.png", 145)
    items = list(open_dataset("icl_nuim", path=folder))
    assert items[0].depth is not None
    assert (items[0].depth > 0).all()
    assert items[1].depth is None or not items[1].depth.any()


def test_depth_of_another_shape_is_left_out(tmp_path: Path) -> None:
    folder = write_icl_nuim(tmp_path, 3)
    write_depth(folder / "depth/1.png", 10000, (48, 48))
    write_depth(folder / "depth/2.png", 10000, (24, 32))  # half size, same aspect: fine
    sequence = open_dataset("icl_nuim", path=folder)
    items = list(sequence)
    assert items[1].depth is None
    assert items[2].depth is not None
    assert items[2].depth.shape == (48, 64)
    assert any("another aspect ratio than their image: 1 (first: 1.png)" in w for w in sequence.warnings)


def test_color_in_a_depth_folder_is_refused(tmp_path: Path) -> None:
    folder = write_icl_nuim(tmp_path, 2)
    write_image(folder / "depth/1.png", 3)
    sequence = open_dataset("icl_nuim", path=folder)
    assert [item.depth is not None for item in sequence] == [True, False]
    assert any("a depth map has one channel" in w for w in sequence.warnings)


@pytest.mark.parametrize(
    ("pixels", "found"),
    [(np.full((48, 64), 2.0, np.float32), "fractions"), (np.full((48, 64), 200, np.uint8), "8 bits")],
)
def test_depth_in_another_unit_is_refused(pixels: np.ndarray, found: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 3)
    Image.fromarray(pixels).save(folder / "depth/0.tiff")
    listing = folder / "depth.txt"
    listing.write_text(listing.read_text().replace("0.png", "0.tiff"))
    sequence = open_dataset("tum", path=folder)
    assert [item.depth is not None for item in sequence] == [False, False, True]
    assert any(f"16 bits, 5000 of them a unit of the poses, and this one has {found}" in w for w in sequence.warnings)


@pytest.mark.parametrize("name", sorted(set(formats()) - {"synthetic"}))
def test_a_missing_path_says_layout_and_source(tmp_path: Path, name: str) -> None:
    for path in (None, tmp_path / "nowhere"):
        with pytest.raises(FileNotFoundError, match=r"expects: .*; where to get it: "):
            open_dataset(name, path=path)


def test_an_unknown_format_lists_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"seven_scenes.*tum"):
        open_dataset("waymo")
