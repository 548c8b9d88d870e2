"""Files that are damaged or hostile: refused with an error that names them, or left out and counted."""

from __future__ import annotations

import bz2
import json
import resource
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from PIL import Image

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.camera import check_intrinsics
from mvsgs_core.datasets import check, open_dataset
from mvsgs_core.datasets.calibration import image_size
from mvsgs_core.datasets.compression import decompress
from mvsgs_core.datasets.exif import read_exif_lens
from mvsgs_core.datasets.files import UnreadableImageError, images_in, natural_order, read_image
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.sequence import Found, ImageSequence, Record
from tests.support.dataset_folders import colmap_text, huge_png, write_image, write_photos, write_replica, write_tum
from tests.support.slam_folders import write_tartanair


def test_a_huge_header_costs_its_image_and_no_more(tmp_path: Path) -> None:
    write_photos(tmp_path, 3)
    huge_png(tmp_path / "photo0.png")
    with pytest.raises(UnreadableImageError, match=r"photo0\.png"):
        read_image(tmp_path / "photo0.png")
    assert read_exif_lens(tmp_path / "photo0.png") is None
    assert image_size(sorted(tmp_path.iterdir())) == (48, 64)
    sequence = open_dataset("images", path=tmp_path, intrinsics="auto")
    assert len(list(sequence)) == 2
    assert any("could not be read: 1 (first: photo0.png" in w for w in sequence.warnings)


def test_what_pillow_knows_beyond_photographs_is_not_opened(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.gif")
    (tmp_path / "a.gif").rename(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match=r"a\.png"):
        read_image(tmp_path / "a.png")


def test_what_is_no_image_is_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("no image")
    code = "import sys; from pathlib import Path; from mvsgs_core.datasets.files import read_image; "
    code += "read_image(Path(sys.argv[1]))"  # in a process of its own: no HEIF image was read there before
    command = [sys.executable, "-c", code, str(tmp_path / "a.jpg")]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    assert "UnreadableImageError: a.jpg: cannot identify image file" in said


def test_depth_that_is_no_number_is_unknown(tmp_path: Path) -> None:
    folder = write_tartanair(tmp_path, frames=1)  # whose depth has fractions
    depth = np.full((48, 64), 1.0, np.float32)
    depth[0, :3] = np.nan, np.inf, -5000
    np.save(folder / "depth_left/000000_left_depth.npy", depth)
    item = next(iter(open_dataset("tartanair", path=folder)))
    assert item.depth is not None
    assert item.depth[0, :4].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1e12])
def test_a_reader_whose_frames_are_at_no_time_is_refused(time: float, tmp_path: Path) -> None:
    @dataclass(kw_only=True, eq=False)
    class Recorder(ImageSequence):
        def _find(self) -> Found:
            images = images_in(tmp_path)
            lens = self._lens(images, Lens((50.0, 50.0, 31.5, 23.5), (48, 64)))
            return Found([Record(seconds, image, lens) for seconds, image in zip((0.0, time), images)])

    write_photos(tmp_path, 2)
    with pytest.raises(ValueError, match=r"photo1\.png is at \S+ s, which is no time"):
        Recorder(path=tmp_path)


@pytest.mark.parametrize("listing", ["rgb.txt", "depth.txt"])
@pytest.mark.parametrize("place", ["parent", "root", "link", "folder link"])
def test_a_list_reads_its_own_folder_only(tmp_path: Path, listing: str, place: str) -> None:
    folder = write_tum(tmp_path / "fr3", 2)
    write_image(tmp_path / "secret/0.png", 77)
    (folder / "link.png").symlink_to(tmp_path / "secret/0.png")
    (folder / "linked").symlink_to(tmp_path / "secret")
    names = {
        "parent": "rgb/../../secret/0.png", "root": str(tmp_path / "secret/0.png"),
        "link": "link.png", "folder link": "linked/0.png",
    }  # fmt: skip
    (folder / listing).write_text(f"0.0 {names[place]}\n")
    with pytest.raises(BadFileError, match=rf"{listing} names .*outside of its folder"):
        open_dataset("tum", path=folder)


def test_links_inside_of_the_folder_are_followed(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 2)
    (folder / "same").symlink_to(folder / "rgb")
    (folder / "rgb.txt").write_text("0.0 same/0.png\n0.1 ./rgb/../rgb/1.png\n")
    assert len(list(open_dataset("tum", path=folder))) == 2


@pytest.mark.parametrize(
    "line", ["nan rgb/0.png", "inf rgb/0.png", "1e300 rgb/0.png", "x rgb/0.png", "0.0 rgb/\x00.png"]
)
def test_lines_that_are_no_images(tmp_path: Path, line: str) -> None:
    folder = write_tum(tmp_path / "fr3", 2)
    (folder / "rgb.txt").write_text(line + "\n")
    with pytest.raises(BadFileError, match=r"rgb\.txt"):
        open_dataset("tum", path=folder)


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


POSE = np.eye(4).tolist()
FRAME = {"file_path": "photo0.png", "transform_matrix": POSE}


@pytest.mark.parametrize(
    "content",
    [
        {"fl_x": 50, "cx": 1e9, "cy": 24, "frames": [FRAME]},
        {"fl_x": 0, "frames": [FRAME]},
        {"fl_x": float("nan"), "frames": [FRAME]},
        {"fl_x": 1e300, "frames": [FRAME]},
        {"fl_x": "50 mm", "frames": [FRAME]},
        {"fl_x": [50], "frames": [FRAME]},
        {"fl_x": 10**400, "frames": [FRAME]},
        {"camera_angle_x": 0, "frames": [FRAME]},
        {"fl_x": 50, "w": 0, "h": 0, "frames": [FRAME]},
        {"fl_x": 50, "w": float("inf"), "frames": [FRAME]},
        {"fl_x": 50, "k1": 1e300, "frames": [FRAME]},
        {"fl_x": 50, "frames": 7},
        {"fl_x": 50, "frames": [7]},
        {"fl_x": 50, "frames": [{"file_path": 7, "transform_matrix": POSE}]},
        {"fl_x": 50, "frames": [{"file_path": "photo0.png", "transform_matrix": [[1, 2], [3]]}]},
        {"fl_x": 50, "frames": [{"file_path": "photo0.png", "transform_matrix": (np.eye(4) * np.nan).tolist()}]},
        {"fl_x": 50, "frames": [{"file_path": "photo0.png", "transform_matrix": [[1, 0, 0, 1e300], *POSE[1:]]}]},
        [1, 2],
        "text",
        None,
    ],
)
def test_transforms_that_cannot_be(tmp_path: Path, content: Any) -> None:
    write_photos(tmp_path, 1)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(BadFileError, match=r"transforms\.json is no transforms.json"):
        open_dataset("images", path=tmp_path)


@pytest.mark.parametrize(
    "content", [nested(200_000).encode(), b"\xff\xfe\xfa", b"", b'{"frames": ' + b"9" * 5000 + b"}"]
)
def test_transforms_that_are_no_json(tmp_path: Path, content: bytes) -> None:
    write_photos(tmp_path, 1)
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(BadFileError, match=r"transforms\.json is no transforms.json"):
        open_dataset("images", path=tmp_path)


@pytest.mark.parametrize("camera", ["1 PINHOLE 64 48 0 51 32 24", "1 PINHOLE 64 48 50 51 1e9 24", "1 PINHOLE x", "1"])
def test_colmap_cameras_that_cannot_be(tmp_path: Path, camera: str) -> None:
    write_photos(tmp_path / "images", 1)
    colmap_text(tmp_path / "sparse", ["photo0.png"])
    (tmp_path / "sparse/cameras.txt").write_text(camera + "\n")
    with pytest.raises(BadFileError, match=r"cameras\.txt"):
        open_dataset("images", path=tmp_path)


@pytest.mark.parametrize("image", ["1 0 0 0 0 1 2 3 1 a.png", "1 1 0 0 0 nan 2 3 1 a.png", "1 1 0 0 0 1 2 3 9 a.png"])
def test_colmap_poses_that_cannot_be(tmp_path: Path, image: str) -> None:
    write_photos(tmp_path / "images", 1)
    colmap_text(tmp_path / "sparse", ["photo0.png"])
    (tmp_path / "sparse/images.txt").write_text(image + "\n\n")
    with np.errstate(invalid="ignore"), pytest.raises(BadFileError, match=r"images\.txt"):
        open_dataset("images", path=tmp_path)


def test_poses_that_are_none_are_left_out(tmp_path: Path) -> None:
    folder = write_replica(tmp_path / "room0")
    lines = (folder / "traj.txt").read_text().splitlines()
    lines[1] = " ".join(["0"] * 16)
    (folder / "traj.txt").write_text("\n".join(lines))
    sequence = open_dataset("replica", path=folder, intrinsics=[100, 100, 59.5, 33.5])
    assert [item.world_from_cam is None for item in sequence] == [False, True, False, False]
    (tmp_path / "cam_params.json").write_text('{"camera": {"w": 120, "h": 68, "fx": 1, "fy": 1, "cx": 1, "cy": 1}}')
    with pytest.raises(BadFileError, match=r"cam_params\.json must hold"):
        open_dataset("replica", path=folder)


@pytest.mark.parametrize(
    "intrinsics",
    [(0, 50, 32, 24), (50, -1, 32, 24), (50, 50, 1e9, 24), (50, 50, 32, -1e3), (1e9, 1e9, 32, 24), (1e-3, 50, 32, 24)],
)
def test_intrinsics_that_no_camera_has(tmp_path: Path, intrinsics: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"focal|principal"):
        check_intrinsics(np.array(intrinsics), (48, 64))
    (write_tum(tmp_path / "x", 1) / "camera.txt").write_text(" ".join(map(str, intrinsics)))
    with pytest.raises(BadFileError, match=r"camera\.txt"):
        open_dataset("tum", path=tmp_path / "x")


def test_an_image_whose_distortion_cannot_be_undone_is_left_out(tmp_path: Path) -> None:
    write_photos(tmp_path, 2)
    frames = [{**FRAME, "file_path": f"photo{i}.png", "k1": 300.0 * i} for i in range(2)]
    content = {"fl_x": 50, "w": 64, "h": 48, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    sequence = open_dataset("images", path=tmp_path)
    assert [item.image[0, 0, 0] for item in sequence] == [20]
    assert any("cannot be undone: 1 (first: photo1.png" in w for w in sequence.warnings)


def test_cropped_and_long_cameras_stay_possible() -> None:
    check_intrinsics(np.array([5000.0, 5000.0, -60.0, 110.0]), (48, 64))


def test_file_names_with_digits_of_other_scripts() -> None:
    assert sorted(["b²", "b10", "b9", "b٣"], key=natural_order)[0] == "b٣"  # a superscript is no number


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "compress"),
    [
        ("zstd", zstandard.ZstdCompressor(write_content_size=False).compress),
        ("zstd", zstandard.compress),
        ("lz4", lz4.frame.compress),
        ("lz4", lambda data: lz4.frame.compress(data, store_size=False)),
        ("bz2", bz2.compress),
    ],
)
def test_decompression_ends_at_its_bound(method: str, compress: Callable[[bytes], bytes]) -> None:
    content = np.random.default_rng(0).integers(0, 9, 100_000, np.uint8).tobytes()
    packed = compress(content)
    assert decompress(packed, method, len(content)) == content
    with pytest.raises(BadFileError, match="more than the"):
        decompress(packed, method, len(content) - 1)
    with pytest.raises(BadFileError, match="damaged"):
        decompress(b"\x01\x02" + packed[2:], method, len(content))
    bomb = compress(bytes(2**28))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadFileError, match="more than the"):
        decompress(bomb, method, 2**20)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**15, "kB"
    with pytest.raises(BadFileError, match="known are"):
        decompress(packed, "rar", 10)


def test_reading_names_the_file_and_keeps_what_names_it_already(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), reading(tmp_path / "a", "is bad"):
        (tmp_path / "a").read_bytes()
    for error in (KeyError("x"), struct.error("short"), RecursionError(), MemoryError(), OSError("cut")):
        with pytest.raises(BadFileError, match=r"/a is bad: \S"), reading(tmp_path / "a", "is bad"):
            raise error
    with pytest.raises(BadFileError) as caught, reading(tmp_path / "a", "is bad"):
        raise ValueError("\x1b[31m" + "x" * 10_000)
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


def test_a_check_says_what_opening_would(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    check("images", path=tmp_path / "photos")
    check("synthetic", frames=3)
    (tmp_path / "empty").mkdir()
    for missing in ("none", "empty"):
        with pytest.raises(FileNotFoundError, match="A folder of images expects"):
            check("images", path=tmp_path / missing)
    with pytest.raises(ValueError, match="no frame left"):
        check("images", path=tmp_path / "photos", start=2)
    with pytest.raises(ValueError, match=r"colour.*there are: .*path"):
        check("images", path=tmp_path / "photos", colour=True)
    for image in (tmp_path / "photos").glob("*.png"):
        image.write_bytes(b"none")
    with pytest.raises(BadFileError, match="no image could be read"):
        check("images", path=tmp_path / "photos", intrinsics=[50, 50, 31.5, 23.5])
