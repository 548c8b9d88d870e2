"""ScanNet's own files."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset, recognized
from tests.support.slam_folders import write_scannet, write_sens

HEADER = 4 + 8 + 15 + 4 * 64  # bytes before the sizes


def test_a_file_gives_what_its_export_gives(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scan/scene.sens")
    assert recognized(path) == recognized(path.parent) == ["sens"]
    sequence = open_dataset("sens", path=path)
    exported = list(open_dataset("scannet", path=write_scannet(tmp_path / "exported", 4)))
    items = list(sequence)
    assert len(sequence) == len(items) == 4
    assert sequence.warnings == ["1 of 4 frames have no true pose"]
    for item, other in zip(items, exported, strict=True):
        np.testing.assert_array_equal(item.image, other.image)
        np.testing.assert_allclose(item.intrinsics, other.intrinsics)
        assert item.timestamp == pytest.approx(other.timestamp)
        assert (item.world_from_cam is None) == (other.world_from_cam is None)
        if item.world_from_cam is not None:
            np.testing.assert_allclose(item.world_from_cam, other.world_from_cam, atol=1e-6)
        np.testing.assert_array_equal(item.depth, other.depth)


def test_a_part_of_the_frames_with_another_camera_smaller(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens", 6)
    sequence = open_dataset("sens", path=tmp_path, start=2, stride=3, size=[96, 128], intrinsics=[180, 180, 127, 95])
    items = list(sequence)
    assert [(int(item.image[0, 0, 0]) - 20, round(30 * item.timestamp)) for item in items] == [(2, 2), (5, 5)]
    assert items[0].image.shape == (96, 128, 3)
    assert items[0].intrinsics[0] == pytest.approx(90)
    with pytest.raises(ValueError, match=r"no frame left: scene\.sens has 6"):
        open_dataset("sens", path=path, start=6)
    path.with_name("another.sens").write_bytes(path.read_bytes())
    with pytest.raises(FileNotFoundError, match=r"has no \.sens file, or several"):
        open_dataset("sens", path=tmp_path)
    assert recognized(tmp_path) == []


def test_a_hidden_file_of_another_disk_is_none(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens")
    path.with_name("._scene.sens").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert recognized(tmp_path) == ["sens"]
    assert len(open_dataset("sens", path=tmp_path)) == 4


def test_a_file_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens")
    path.write_bytes(path.read_bytes()[:-10])
    sequence = open_dataset("sens", path=path)
    assert sequence.warnings[0] == "scene.sens was cut off or is damaged: read are 3 of 4 frames"
    with pytest.raises(ValueError, match=r"no frame left: scene\.sens has 3, wanted from 3"):
        open_dataset("sens", path=path, start=3)
    assert len(list(sequence)) == 3


def test_a_length_that_no_image_has_ends_it(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens")
    content = path.read_bytes()
    second = content.index(b"\x89PNG", content.index(b"\x89PNG") + 1)
    with path.open("r+b") as file:
        file.seek(second - 16)
        file.write(struct.pack("<Q", 2**30))
        file.truncate(2**31)  # a sparse file, which has as many
    sequence = open_dataset("sens", path=path)
    assert len(sequence) == 1
    assert "read are 1 of 4" in sequence.warnings[0]


def test_the_folder_of_an_export_is_that_of_the_file_where_it_is_asked_for(tmp_path: Path) -> None:
    write_sens(tmp_path / "scene.sens")
    (tmp_path / "other.sens").mkdir()
    (tmp_path / "color").mkdir()
    assert recognized(tmp_path) == []
    assert len(open_dataset("sens", path=tmp_path)) == 4


def test_depth_is_where_a_lens_that_bends_shows_it(tmp_path: Path) -> None:
    """A step in the depth lies where it lies in the undistorted image, not undistorted twice."""
    path = write_sens(tmp_path / "scene.sens", 1)
    depth = np.full((96, 128), 2000, dtype="<u2")
    content = path.read_bytes()
    step = depth.copy()
    step[:, 96:] = 3000
    before, after = zlib.compress(depth.tobytes()), zlib.compress(step.tobytes())
    content = content.replace(before, after).replace(struct.pack("<Q", len(before)), struct.pack("<Q", len(after)))
    path.write_bytes(content)
    options = {"path": path, "intrinsics": [200, 200, 127.5, 95.5], "crop": 0}
    (plain,) = open_dataset("sens", **options)
    (bent,) = open_dataset("sens", distortion=[1.0, 0, 0, 0], **options)
    edges = []
    for item in (plain, bent):
        assert item.depth is not None
        row = item.depth[96]
        edges.append(int(np.flatnonzero(row > 2.5)[0]))
    assert abs(edges[0] - edges[1]) <= 2


def test_damaged_images_and_depth_are_left_out(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens")
    whole = path.read_bytes()
    images = [at for at in range(len(whole)) if whole.startswith(b"\x89PNG", at)]
    depth = zlib.compress(np.full((96, 128), 2000, dtype="<u2").tobytes())
    second = whole.index(depth, images[1])
    damaged = bytearray(whole)
    damaged[images[0] : images[0] + 40] = bytes(40)
    damaged[second : second + 10] = bytes(10)
    path.write_bytes(damaged)
    sequence = open_dataset("sens", path=path)
    items = list(sequence)
    assert [int(item.image[0, 0, 0]) - 20 for item in items] == [1, 2, 3]
    assert [item.depth is None for item in items] == [True, False, False]
    assert any("images left out because they could not be read: 1 (first: frame 0: " in w for w in sequence.warnings)
    assert any("depth maps that could not be read" in w and "(first: frame 1: " in w for w in sequence.warnings)


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (0, 3, "version 3; read is 4"),
        (HEADER, 7, "color compressed by 7"),
        (HEADER + 4, 2, "depth by 2, which is not read"),
        (HEADER + 8, 2**31, "images of a size"),
        (12 + 15, 0, "focal"),
    ],
)
def test_a_header_that_cannot_be_is_refused(tmp_path: Path, at: int, value: int, said: str) -> None:
    path = write_sens(tmp_path / "scene.sens")
    content = bytearray(path.read_bytes())
    content[at : at + 4] = struct.pack("<I", value)
    path.write_bytes(content)
    with pytest.raises(BadFileError, match=rf"scene\.sens is no \.sens file that can be read: .*{said}"):
        open_dataset("sens", path=path)


def test_depth_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens", 1)
    depth = zlib.compress(np.full((96, 128), 2000, dtype="<u2").tobytes())
    bomb = zlib.compress(bytes(10**8))
    content = path.read_bytes().replace(depth, bomb)
    path.write_bytes(content.replace(struct.pack("<Q", len(depth)), struct.pack("<Q", len(bomb))))
    sequence = open_dataset("sens", path=path)
    (item,) = sequence
    assert item.depth is None
    assert any(f"{2 * 96 * 128 + 1} bytes, where it has {2 * 96 * 128}" in w for w in sequence.warnings)
