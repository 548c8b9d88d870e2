"""Frames in the layout of 7-Scenes that another camera than Kinect took: 12-Scenes, 3RScan, SensReader, 3DMatch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset, recognized
from tests.support.dataset_folders import pose, write_image, write_seven_scenes

Size = tuple[int, int]
STRUCTURE = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 324
m_colorHeight = 242
m_depthWidth = 160
m_depthHeight = 120
m_depthShift = 2000
m_calibrationColorIntrinsic = 289.5 0 162 0 0 288.5 120.5 0 0 0 1 0 0 0 0 1\x20
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\x20
m_calibrationDepthIntrinsic = 143 0 80 0 0 143 60 0 0 0 1 0 0 0 0 1\x20
m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\x20
m_frames.size = 2
"""
# depth of 3RScan has another shape than color, and pixels that are not square
TANGO = """m_colorWidth = 240
m_colorHeight = 135
m_depthWidth = 112
m_depthHeight = 86
m_depthShift = 1000
m_calibrationColorIntrinsic = 219 0 120 0 0 219 67 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 102 0 56 0 0 136 43 0 0 0 1 0 0 0 0 1
"""


def write_frames(folder: Path, size: Size, depth: Size | None = None, suffix: str = "png") -> None:
    """Two frames with depth of 4000 counts. suffix: of the depth maps."""
    for i in range(2):
        stem = folder / f"frame-{i:06d}"
        write_image(stem.with_suffix(".color.jpg"), 20 + i, size)
        counts = np.full(depth or size, 4000, dtype=np.uint16)
        if suffix == "png":
            Image.fromarray(counts).save(stem.with_suffix(".depth.png"))
        else:
            header = f"P5\n# data values are 16-bit each\n{counts.shape[1]} {counts.shape[0]}\n65535\n"
            stem.with_suffix(".depth.pgm").write_bytes(header.encode() + counts.astype(">u2").tobytes())
        stem.with_suffix(".pose.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose(i)))


@pytest.mark.parametrize("inside", [True, False])
def test_twelve_scenes(tmp_path: Path, inside: bool) -> None:
    scene = tmp_path / "apt1/kitchen"
    write_frames(scene / "data", (242, 324), (120, 160))
    (scene / ("data/info.txt" if inside else "info.txt")).write_text(STRUCTURE)
    for path in (scene, scene / "data"):
        assert recognized(path) == ["seven_scenes"]
        sequence = open_dataset("seven_scenes", path=path)
        items = list(sequence)
        assert sequence.warnings == []
        assert len(items) == 2
        np.testing.assert_allclose(items[0].intrinsics, [289.5, 288.5, 162, 120.5])
        np.testing.assert_array_equal(items[1].world_from_cam, pose(1))  # the color camera's, as it is
        assert items[0].depth is not None
        assert items[0].depth[121, 162] == pytest.approx(2.0)  # 2000 counts a meter


def test_smaller_copies_of_twelve_scenes(tmp_path: Path) -> None:
    write_frames(tmp_path, (121, 162), (120, 160))
    (tmp_path / "info.txt").write_text(STRUCTURE)
    np.testing.assert_allclose(
        next(iter(open_dataset("seven_scenes", path=tmp_path))).intrinsics, [144.75, 144.25, 80.75, 60.0]
    )
    given = next(iter(open_dataset("seven_scenes", path=tmp_path, intrinsics=[150, 151, 80, 60])))
    np.testing.assert_allclose(given.intrinsics, [150, 151, 80, 60])


def test_3rscan(tmp_path: Path) -> None:
    folder = tmp_path / "0a4b8ef6/sequence"
    write_frames(folder, (135, 240), (86, 112), "pgm")
    write_image(folder / "frame-000000.rendered.color.jpg", 99, (135, 240))
    (folder / "_info.txt").write_text(TANGO)
    for path in (folder, folder.parent):
        assert recognized(path) == ["seven_scenes"]
        sequence = open_dataset("seven_scenes", path=path)
        items = list(sequence)
        assert sequence.warnings == []
        assert [item.image.shape for item in items] == [(135, 240, 3)] * 2
        np.testing.assert_allclose(items[0].intrinsics, [219, 219, 120, 67])
        depth = items[0].depth
        assert depth is not None
        assert depth.shape == (135, 240)
        assert np.mean(depth == 4.0) > 0.9
        assert set(np.unique(depth)) <= {0.0, 4.0}


def test_depth_of_another_shape_lies_where_color_sees_it(tmp_path: Path) -> None:
    write_frames(tmp_path, (135, 240), (86, 112), "pgm")
    (tmp_path / "_info.txt").write_text(TANGO)
    counts = np.full((86, 112), 4000, dtype=np.uint16)
    counts[20:30, 30:40] = 1000
    Image.fromarray(counts).save(tmp_path / "frame-000000.depth.pgm")
    depth = next(iter(open_dataset("seven_scenes", path=tmp_path))).depth
    assert depth is not None
    v, u = np.nonzero(depth == 1.0)
    np.testing.assert_allclose(np.mean(u), 219 * (34.5 - 56) / 102 + 120, atol=1.5)
    np.testing.assert_allclose(np.mean(v), 219 * (24.5 - 43) / 136 + 67, atol=1.5)


@pytest.mark.parametrize(
    "change",
    [
        ("m_depthShift = 1000", "m_depthShift = 0"), ("m_colorWidth = 240", ""), ("Width = 240", "Width ="),
        ("219 0 120", "nan 0 120"), ("219 0 120", ""), ("m_colorHeight = 135", "m_colorHeight = 1e9"),
    ],
)  # fmt: skip
def test_a_damaged_info_is_named(tmp_path: Path, change: tuple[str, str]) -> None:
    write_frames(tmp_path, (135, 240))
    (tmp_path / "_info.txt").write_text(TANGO.replace(*change))
    with pytest.raises(BadFileError, match=r"_info\.txt must hold lines such as"):
        open_dataset("seven_scenes", path=tmp_path)


def test_an_info_of_another_kind_says_nothing(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path)
    (folder / "info.txt").write_bytes(b"recorded by me = \xff\n")
    np.testing.assert_allclose(next(iter(open_dataset("seven_scenes", path=folder))).intrinsics, [525, 525, 320, 240])


def test_camera_intrinsics_of_other_cameras_than_kinect(tmp_path: Path) -> None:
    """3DMatch gives one camera, to which depth is registered; that of 7-Scenes itself is Kinect's."""
    folder = write_seven_scenes(tmp_path)
    (folder / "camera-intrinsics.txt").write_text("570.342205 0 320\n0 570.342205 240\n0 0 1\n")
    for path in (folder, folder / "seq-01"):
        items = list(open_dataset("seven_scenes", path=path))
        np.testing.assert_allclose(items[0].intrinsics, [570.342205, 570.342205, 320, 240])
        np.testing.assert_array_equal(items[2].world_from_cam, pose(2))
        assert items[0].depth is not None
        assert (items[0].depth == 2.0).all()
    (folder / "camera-intrinsics.txt").write_text("585 0 320 0 585 240 0 0 1")
    items = list(open_dataset("seven_scenes", path=folder))
    np.testing.assert_allclose(items[0].intrinsics, [525, 525, 320, 240])
    np.testing.assert_allclose(items[2].world_from_cam, pose(2) + 0.021 * np.eye(4, k=3))
    (folder / "camera-intrinsics.txt").write_text("585 0 320")
    with pytest.raises(BadFileError, match=r"camera-intrinsics\.txt must hold a 3x3"):
        open_dataset("seven_scenes", path=folder)


def test_smaller_copies_of_7_scenes_are_kinects_to_a_pixel(tmp_path: Path) -> None:
    write_frames(tmp_path, (256, 341), (480, 640))
    items = list(open_dataset("seven_scenes", path=tmp_path))
    np.testing.assert_allclose(items[0].intrinsics[:2], [525 * 341 / 640, 525 * 256 / 480])
    np.testing.assert_allclose(items[1].world_from_cam, pose(1) + 0.021 * np.eye(4, k=3))


def test_images_that_are_not_kinects_are_refused_without_their_camera(tmp_path: Path) -> None:
    write_frames(tmp_path, (135, 240))
    with pytest.raises(ValueError, match=r"240x135, and those of 7-Scenes are 640x480: .*_info\.txt .* dataset\.intr"):
        open_dataset("seven_scenes", path=tmp_path)
    items = list(open_dataset("seven_scenes", path=tmp_path, intrinsics=[219, 219, 120, 67]))
    np.testing.assert_allclose(items[0].intrinsics, [219, 219, 120, 67])
    np.testing.assert_array_equal(items[1].world_from_cam, pose(1))
    assert items[0].depth is not None
    assert (items[0].depth == 4.0).all()
