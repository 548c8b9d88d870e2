"""Folders of images, and the ways in which they are calibrated."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.colmap import lens_of, read_colmap
from mvsgs_core.geometry import inverse, quaternion_from_rotation
from tests.support.dataset_folders import POSES, colmap_text, truncate, write_image, write_photos
from tests.support.slam_folders import write_kitti

PHOTO = Path(__file__).parents[2] / "support" / "photo.heic"


def colmap_binary(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 50, 51, 32, 24))
    data = struct.pack("<Q", len(names))
    for i, name in enumerate(names):
        cam_from_world = inverse(POSES[i])
        q = quaternion_from_rotation(cam_from_world[:3, :3])
        data += struct.pack("<i7di", i + 1, *q, *cam_from_world[:3, 3], 1) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.5, 2.5, -1, 3.0, 4.0, 7)
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("write", [colmap_text, colmap_binary])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_colmap_model(tmp_path: Path, write: Callable[[Path, list[str]], None], place: str) -> None:
    write_photos(tmp_path / "scene/images", 4)
    if place == ".":
        write(tmp_path / "elsewhere", ["photo0.png", "photo1.png", "photo3.png"])
        sequence = open_dataset("images", path=tmp_path / "scene", model=tmp_path / "elsewhere")
    else:
        write(tmp_path / "scene" / place, ["photo0.png", "photo1.png", "photo3.png"])
        sequence = open_dataset("images", path=tmp_path / "scene")
    items = list(sequence)
    assert len(items) == 4
    for i, item in enumerate(items):
        np.testing.assert_allclose(item.intrinsics, [50, 51, 31.5, 23.5])  # COLMAP's origin is the pixel's corner
        if i == 2:
            assert item.world_from_cam is None
        else:
            np.testing.assert_allclose(item.world_from_cam, POSES[min(i, 2)], atol=1e-12)
    assert sequence.warnings == [
        "images that the COLMAP model does not know, they have no true pose: 1 (first: photo2.png)"
    ]


def test_a_model_of_several_cameras_with_equal_file_names(tmp_path: Path) -> None:
    names = [f"{camera}/{i}.png" for camera in ("left", "right") for i in range(2)]
    for i, name in enumerate(names):
        write_image(tmp_path / "images" / name, 20 + i)
    colmap_text(tmp_path / "sparse/0", names)
    for i, item in enumerate(open_dataset("images", path=tmp_path)):
        assert item.image[0, 0, 0] == 20 + i
        np.testing.assert_allclose(item.world_from_cam, POSES[i], atol=1e-12)


def test_a_folder_without_images_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="has no image; A folder of images expects: "):
        open_dataset("images", path=tmp_path)


def test_damaged_colmap_models(tmp_path: Path) -> None:
    colmap_binary(tmp_path / "a", ["photo0.png"])
    truncate(tmp_path / "a/images.bin", 0.5)
    with pytest.raises(ValueError, match="damaged or incomplete"):
        read_colmap(tmp_path / "a")
    colmap_text(tmp_path / "b", [])
    with pytest.raises(ValueError, match="no registered image"):
        read_colmap(tmp_path / "b")
    write_photos(tmp_path / "photos", 2)
    colmap_text(tmp_path / "c", ["other0.png"])
    with pytest.raises(ValueError, match=r"knows none of the images: it names other0.png, here is photo0.png"):
        open_dataset("images", path=tmp_path / "photos", model=tmp_path / "c")
    with pytest.raises(FileNotFoundError, match="is missing"):
        open_dataset("images", path=tmp_path / "photos", model=tmp_path / "d")
    with pytest.raises(ValueError, match="not both"):
        open_dataset("images", path=tmp_path / "photos", model=tmp_path / "c", intrinsics=[1, 1, 1, 1])


@pytest.mark.parametrize(
    ("model", "parameters", "focal", "distortion", "fisheye"),
    [
        ("SIMPLE_PINHOLE", (50, 32, 24), (50, 50), (), False),
        ("SIMPLE_RADIAL", (50, 32, 24, 0.1), (50, 50), (0.1, 0, 0, 0), False),
        ("RADIAL", (50, 32, 24, 0.1, 0.2), (50, 50), (0.1, 0.2, 0, 0), False),
        ("OPENCV", (50, 51, 32, 24, 1, 2, 3, 4), (50, 51), (1, 2, 3, 4), False),
        ("FULL_OPENCV", (50, 51, 32, 24, *range(8)), (50, 51), tuple(range(8)), False),
        ("OPENCV_FISHEYE", (50, 51, 32, 24, 1, 2, 3, 4), (50, 51), (1, 2, 3, 4), True),
        ("SIMPLE_RADIAL_FISHEYE", (50, 32, 24, 0.1), (50, 50), (0.1, 0, 0, 0), True),
        ("RADIAL_FISHEYE", (50, 32, 24, 0.1, 0.2), (50, 50), (0.1, 0.2, 0, 0), True),
        ("SIMPLE_FISHEYE", (50, 32, 24), (50, 50), (0, 0, 0, 0), True),
        ("FISHEYE", (50, 51, 32, 24), (50, 51), (0, 0, 0, 0), True),
    ],
)
def test_colmap_camera_models(
    model: str, parameters: tuple[float, ...], focal: tuple[float, float], distortion: tuple[float, ...], fisheye: bool
) -> None:
    lens = lens_of(model, 64, 48, parameters)
    assert lens.intrinsics == (*focal, 31.5, 23.5)
    assert (lens.size, lens.distortion, lens.fisheye) == ((48, 64), distortion, fisheye)


def test_colmap_models_without_counterpart() -> None:
    for model, parameters in (("FOV", (50, 51, 32, 24, 0.5)), ("DIVISION", (50, 51, 32, 24, 0.1)), ("EUCM", (9,) * 6)):
        with pytest.raises(ValueError, match=f"{model} is not supported: run `colmap image_undistorter`"):
            lens_of(model, 64, 48, parameters)
    with pytest.raises(ValueError, match="unknown"):
        lens_of("PINHOLE", 64, 48, (50, 51, 32))


def test_transforms_json(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 3)
    frames = []
    for i in range(2):
        opengl = POSES[i] @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./images/photo{i}" + (".png" if i else ""), "transform_matrix": opengl.tolist()})
    content = {"fl_x": 100.0, "fl_y": 102.0, "cx": 64.0, "cy": 48.0, "w": 128, "h": 96, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    items = list(open_dataset("images", path=tmp_path))
    for i in range(2):
        np.testing.assert_allclose(items[i].world_from_cam, POSES[i], atol=1e-12)
    np.testing.assert_allclose(items[0].intrinsics, [50, 51, 31.5, 23.5])  # images at half the size
    assert items[2].world_from_cam is None
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames}))
    np.testing.assert_allclose(next(iter(open_dataset("images", path=tmp_path))).intrinsics, [32, 32, 31.5, 23.5])
    frames[0]["transform_matrix"][0][0] = 7.0
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="no rotation"):
        open_dataset("images", path=tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(ValueError, match=r"is no transforms.json"):
        open_dataset("images", path=tmp_path)


@pytest.mark.parametrize(
    ("model", "fisheye"),
    [
        (None, False), ("SIMPLE_PINHOLE", False), ("RADIAL", False), ("SIMPLE_RADIAL_FISHEYE", True),
        ("OPENCV_FISHEYE", True), ("EQUIRECTANGULAR", None), ("FISHEYE624", None), ("THIN_PRISM_FISHEYE", None),
    ],
)  # fmt: skip
def test_camera_models_of_transforms_json(model: str | None, fisheye: bool | None, tmp_path: Path) -> None:
    write_photos(tmp_path, 1)
    frames = [{"file_path": "photo0.png", "transform_matrix": np.eye(4).tolist()}]
    content = {"camera_model": model, "fl_x": 50.0, "k1": 0.01, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    if fisheye is None:
        with pytest.raises(ValueError, match=f"camera_model {model} is not supported: undistort the images"):
            open_dataset("images", path=tmp_path)
    else:
        assert open_dataset("images", path=tmp_path).lens.fisheye == fisheye


def test_strecha_cameras_are_for_the_full_size(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 2, ".jpg")
    (tmp_path / "gt_dense_cameras").mkdir()
    text = "100 0 63.5\n0 102 47.5\n0 0 1\n0 0 0\n1 0 0\n0 0 -1\n0 1 0\n5 6 7\n128 96\n"
    for i in range(2):
        (tmp_path / f"gt_dense_cameras/photo{i}.jpg.camera").write_text(text)
    item = list(open_dataset("images", path=tmp_path))[1]
    np.testing.assert_allclose(item.intrinsics, [50, 51, 31.5, 23.5])
    np.testing.assert_allclose(item.world_from_cam, [[1, 0, 0, 5], [0, 0, -1, 6], [0, 1, 0, 7], [0, 0, 0, 1]])
    (tmp_path / "gt_dense_cameras/._photo0.jpg.camera").write_bytes(b"\x00\x05\x16\x07Mac OS X")
    assert len(list(open_dataset("images", path=tmp_path))) == 2
    (tmp_path / "gt_dense_cameras/photo0.jpg.camera").write_text("1 2 3")
    with pytest.raises(ValueError, match="must hold 26 numbers"):
        open_dataset("images", path=tmp_path)


def save_photo(path: Path, exif: dict[int, float], size: tuple[int, int] = (48, 64), orientation: int = 1) -> None:
    image = Image.fromarray(np.arange(size[0] * size[1] * 3, dtype=np.uint32).reshape(*size, 3).astype(np.uint8))
    header = Image.Exif()
    header[0x0112] = orientation
    for tag, value in exif.items():
        header.get_ifd(0x8769)[tag] = value
    image.save(path, exif=header)


def test_focal_length_from_exif(tmp_path: Path) -> None:
    equivalent, focal, resolution, unit, width, height = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003
    save_photo(tmp_path / "a.jpg", {equivalent: 26})
    sequence = open_dataset("images", path=tmp_path)
    assert next(iter(sequence)).intrinsics[0] == pytest.approx(26 * 80 / np.hypot(36, 24))
    assert "intrinsics are from EXIF: focal length 48 pixels for 64x48" in sequence.warnings[0]
    auto = open_dataset("images", path=tmp_path, intrinsics="auto")
    assert next(iter(auto)).intrinsics[0] == pytest.approx(26 * 80 / np.hypot(36, 24))
    assert not next(iter(auto)).intrinsics_guessed
    assert "intrinsics are from EXIF" in auto.warnings[0]
    # 4.5 mm in front of 160 pixels a millimeter, on a picture that was 640 wide and is 64 now
    sensor = {equivalent: 42, focal: 4.5, resolution: 1600.0, unit: 3, width: 640, height: 480}
    save_photo(tmp_path / "a.jpg", sensor)
    write_image(tmp_path / "b.jpg", 5)
    sequence = open_dataset("images", path=tmp_path)
    for item in sequence:
        np.testing.assert_allclose(item.intrinsics, [72, 72, 31.5, 23.5])
    assert "images without an EXIF focal length, which take the first one's: 1" in sequence.warnings


BENT = [-0.2, 0.05, 0.0, 0.0]


def test_a_given_distortion_is_of_lenses_from_exif(tmp_path: Path) -> None:
    save_photo(tmp_path / "a.jpg", {0xA405: 26})
    write_image(tmp_path / "b.jpg", 5)
    sequence = open_dataset("images", path=tmp_path, distortion=BENT)
    assert [record.lens.distortion for record in sequence.records] == 2 * [tuple(BENT)]  # type: ignore[attr-defined]
    assert "distortion as given" in sequence.warnings[0]


def test_a_given_distortion_beside_another_calibration_is_refused(tmp_path: Path) -> None:
    write_kitti(tmp_path / "kitti")
    write_photos(tmp_path / "photos/images", 1)
    colmap_text(tmp_path / "photos/sparse/0", ["photo0.png"])
    for name, path in (("kitti", tmp_path / "kitti/sequences/07"), ("images", tmp_path / "photos")):
        with pytest.raises(ValueError, match=r"dataset.distortion is not used .*: give dataset.intrinsics=\[fx"):
            open_dataset(name, path=path, distortion=BENT)
        sequence = open_dataset(name, path=path, distortion=BENT, intrinsics=[50, 50, 31.5, 23.5])
        assert sequence.lens.distortion == tuple(BENT)


def test_exposure_from_exif(tmp_path: Path) -> None:
    seconds, stop, iso = 0x829A, 0x829D, 0x8827
    save_photo(tmp_path / "a.jpg", {0xA405: 26, seconds: 0.01, stop: 2.0, iso: 100})
    save_photo(tmp_path / "b.jpg", {0xA405: 26, seconds: 0.02, stop: 2.0, iso: 400})
    save_photo(tmp_path / "c.jpg", {0xA405: 26, seconds: 0.02, iso: 400})
    save_photo(tmp_path / "d.jpg", {0xA405: 26, seconds: 0.0, stop: 2.0, iso: 400})
    exposures = [item.exposure for item in open_dataset("images", path=tmp_path)]
    assert exposures == pytest.approx([0.25, 2.0, 0.0, 0.0])


def test_photos_are_turned_upright(tmp_path: Path) -> None:
    save_photo(tmp_path / "a.jpg", {0xA405: 26}, orientation=6)
    item = next(iter(open_dataset("images", path=tmp_path)))
    assert item.image.shape == (64, 48, 3)
    np.testing.assert_allclose(item.intrinsics[2:], [23.5, 31.5])


def test_natural_order_and_subfolders(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 11)
    items = list(open_dataset("images", path=tmp_path, intrinsics=[50, 51, 31.5, 23.5], rate=10.0))
    assert [item.image[0, 0, 0] for item in items] == list(range(20, 31))
    assert items[10].timestamp == pytest.approx(1.0)
    np.testing.assert_allclose(items[0].intrinsics, [50, 51, 31.5, 23.5])
    large = open_dataset("images", path=tmp_path, intrinsics=[100, 102, 63.5, 47.5])
    assert any("of another size (about 128x96)" in w for w in large.warnings)


def test_a_calibration_of_turned_images_is_said_with_the_numbers_to_give(tmp_path: Path) -> None:
    write_photos(tmp_path, 2)  # of 64x48
    (told,) = open_dataset("images", path=tmp_path, intrinsics=[50, 51, 24, 31]).warnings
    assert "is that of images of 48x64, and these are 64x48" in told
    assert "dataset.intrinsics=[50,51,31,24] (turned: [51,50,31,24])" in told
    for center in ((31, 24), (29, 26), (27, 27), (24, 24), (20, 31)):  # in the middle, off it, of a cropped picture
        assert not open_dataset("images", path=tmp_path, intrinsics=[50, 51, *center]).warnings


def test_without_calibration_it_says_what_to_do(tmp_path: Path) -> None:
    write_photos(tmp_path, 2)
    uncalibrated = open_dataset("images", path=tmp_path)
    assert "no calibration" in uncalibrated.warnings[0]
    assert "are a guess" in uncalibrated.warnings[1]
    assert all(item.intrinsics_guessed for item in uncalibrated), "as of a video: the tracker estimates it"
    guessed = open_dataset("images", path=tmp_path, intrinsics="auto", size=[24, 32])
    assert "are a guess" in guessed.warnings[0]
    assert all(item.intrinsics_guessed for item in guessed)
    bent = open_dataset("images", path=tmp_path, intrinsics="auto", distortion=[0.2, 0.0, 0.0, 0.0], size=[24, 32])
    assert "the given distortion" in bent.warnings[0]
    assert next(iter(bent)).intrinsics[0] != next(iter(guessed)).intrinsics[0], "undistortion zooms in"
    known = open_dataset("images", path=tmp_path, intrinsics=[50, 50, 31.5, 23.5])
    assert not any(item.intrinsics_guessed for item in known)
    for bad in ("guess", [1, 2, 3], [-1, 1, 1, 1]):
        with pytest.raises(ValueError, match=r"intrinsics is|positive"):
            open_dataset("images", path=tmp_path, intrinsics=bad)


@pytest.mark.parametrize("size", [None, (24, 32)])
def test_mixed_sizes(tmp_path: Path, size: tuple[int, int] | None) -> None:
    sizes = {"a": (48, 64), "b": (96, 128), "c": (64, 48), "d": (48, 64), "e": (48, 80)}
    for i, (name, shape) in enumerate(sizes.items()):
        write_image(tmp_path / f"{name}.png", 20 + i, shape)
    sequence = open_dataset("images", path=tmp_path, intrinsics="auto", size=size)
    items = list(sequence)
    assert [(item.index, item.image[0, 0, 0]) for item in items] == [(0, 20), (1, 21), (2, 23)]
    assert {item.image.shape[:2] for item in items} == {size or (48, 64)}
    for item in items:
        np.testing.assert_allclose(item.intrinsics, items[0].intrinsics)
    assert "images scaled to the size of the others: 1 (first: b.png, 128x96 for 64x48)" in sequence.warnings
    assert (
        "images left out because their calibration is for another aspect ratio: 2 (first: c.png, 48x64 for 64x48)"
        in sequence.warnings
    )


def test_mixed_sizes_with_a_calibration_each(tmp_path: Path) -> None:
    save_photo(tmp_path / "a.jpg", {0xA405: 26})
    save_photo(tmp_path / "b.jpg", {0xA405: 26}, (64, 48))
    sequence = open_dataset("images", path=tmp_path)
    assert len(list(sequence)) == 1
    left_out = (
        "images left out because they have another aspect ratio than the others: 1 (first: b.jpg, 48x64 for 64x48)"
    )
    assert left_out in sequence.warnings


def test_gray_palette_and_16_bit_images(tmp_path: Path) -> None:
    Image.fromarray(np.full((48, 64), 7, dtype=np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.full((48, 64), 8 * 256, dtype=np.uint16)).save(tmp_path / "b.png")
    Image.fromarray(np.full((48, 64, 4), 9, dtype=np.uint8)).save(tmp_path / "c.png")
    Image.fromarray(np.full((48, 64, 3), 51, dtype=np.uint8)).convert("P").save(tmp_path / "d.png")
    items = list(open_dataset("images", path=tmp_path, intrinsics="auto"))
    assert [item.image[5, 5].tolist() for item in items] == [[7] * 3, [8] * 3, [9] * 3, [51] * 3]


def test_truncated_photos(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        save_photo(tmp_path / f"{name}.jpg", {0xA405: 26})
    truncate(tmp_path / "a.jpg", 0.9)
    truncate(tmp_path / "c.jpg", 0.01)
    sequence = open_dataset("images", path=tmp_path)
    assert len(list(sequence)) == 1
    assert any(
        w.startswith("images left out because they could not be read: 2 (first: a.jpg") for w in sequence.warnings
    )


def test_photographs_of_phones(tmp_path: Path) -> None:
    """HEIC, turned by its header: red above blue became red to the right; 26 mm of focal length."""
    for name in ("IMG_1.HEIC", "IMG_2.heic"):
        shutil.copy(PHOTO, tmp_path / name)
    items = list(open_dataset("images", path=tmp_path))
    assert len(items) == 2
    image = items[1].image
    assert image.shape == (64, 48, 3)
    assert image[:, 30:, 0].min() > 150 > 100 > image[:, 30:, 2].max()
    assert image[:, :18, 2].min() > 150 > 100 > image[:, :18, 0].max()
    np.testing.assert_allclose(items[1].intrinsics[0], 26 * np.hypot(64, 48) / np.hypot(36, 24), rtol=1e-6)


def test_avif(tmp_path: Path) -> None:
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(tmp_path / "a.avif")
    np.testing.assert_allclose(next(iter(open_dataset("images", path=tmp_path))).image, 90, atol=3)


def test_a_fisheye_lens_is_given_in_words(tmp_path: Path) -> None:
    write_photos(tmp_path, 1)
    options = {"path": tmp_path, "intrinsics": [30, 30, 31.5, 23.5], "crop": 0}
    fisheye = open_dataset("images", distortion=["fisheye", 0.1, 0, 0, 0], **options)
    assert fisheye.lens.fisheye
    assert fisheye.lens.distortion == (0.1, 0, 0, 0)
    with pytest.raises(ValueError, match=r"distortion is \[k1, k2, p1, p2\(, k3, \.\.\.\)\] or \[fisheye"):
        open_dataset("images", distortion=["wide", 0.1, 0, 0, 0], **options)
