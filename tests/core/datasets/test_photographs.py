"""Folders of photographs as people have them: which of the files they are, their sizes, turns, focal lengths, times."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile

from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.datasets.exif import read_exif_exposure, read_exif_lens, read_exif_place, read_exif_time
from mvsgs_core.datasets.files import opened_image, upright_size
from tests.support.dataset_folders import write_image, write_photos

EQUIVALENT, FOCAL, RESOLUTION, UNIT, WIDTH, HEIGHT = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003
TAKEN, OFFSET, FRACTION = 0x9003, 0x9011, 0x9291
HEIGHT_ON_DISK, WIDTH_ON_DISK = 48, 64


def photograph(
    path: Path,
    exif: dict[int, object] | None = None,
    orientation: int = 1,
    right: int = 200,
    size: tuple[int, int] = (HEIGHT_ON_DISK, WIDTH_ON_DISK),
) -> Path:
    """Black, and `right` in its right half, as the camera took it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((*size, 3), np.uint8)
    pixels[:, size[1] // 2 :] = right
    header = Image.Exif()
    header[0x0112] = orientation
    header.get_ifd(0x8769).update(exif or {})
    Image.fromarray(pixels).save(path, exif=header)
    return path


def opened(path: Path, **options: object) -> tuple[list[Item], list[str]]:
    sequence = open_dataset("images", path=path, **options)
    return list(sequence), sequence.warnings


def test_a_picture_beside_the_folder_of_images_is_none_of_them(tmp_path: Path) -> None:
    write_photos(tmp_path / "images", 6)
    write_image(tmp_path / "preview.png", 200, (20, 30))
    found, warnings = opened(tmp_path)
    assert [item.image[0, 0, 0] for item in found] == list(range(20, 26))
    told = "the images are those directly in {}; others in {} that are not read: {}"
    assert told.format(tmp_path / "images", tmp_path, "1 (first: preview.png)") in warnings
    for n in range(3):  # as many or nearly: the images are those of the folder
        write_image(tmp_path / f"{n}.png", 100 + n)
    (tmp_path / "preview.png").unlink()
    found, warnings = opened(tmp_path)
    assert [item.image[0, 0, 0] for item in found] == [100, 101, 102]
    assert told.format(tmp_path, tmp_path, "6 (first: images/photo0.png)") in warnings


def test_a_runs_pictures_of_its_map_are_no_images(tmp_path: Path) -> None:
    for folder, settings in (("first", "sharp: true\n"), ("output", "# mvsgs photos\ndataset: {}\n")):
        write_photos(tmp_path / folder / "keyframes", 4)
        (tmp_path / folder / "config.yaml").write_text(settings)
    found, warnings = opened(tmp_path)
    assert len(found) == 4
    assert not [text for text in warnings if "output" in text]


def test_hidden_files_masks_depth_and_normals_are_no_images(tmp_path: Path) -> None:
    for camera in ("100MEDIA", "101MEDIA"):
        photograph(tmp_path / camera / "DJI_0001.JPG")
        (tmp_path / camera / "._DJI_0001.JPG").write_bytes(b"\0\5\x16\7")
        photograph(tmp_path / ".thumbnails" / camera / "DJI_0001.JPG")
    found, warnings = opened(tmp_path)
    assert len(found) == 2
    assert not any("not read" in w for w in warnings)
    write_photos(tmp_path / "test", 2)
    for name in ("photo0_depth_0001.png", "photo1_normal_0001.png", "alone_depth_0001.png"):
        write_image(tmp_path / "test" / name, 90)
    assert [item.image[0, 0, 0] for item in opened(tmp_path / "test")[0]] == [90, 20, 21]


def test_the_size_is_that_of_most_and_not_of_the_first(tmp_path: Path) -> None:
    write_image(tmp_path / "0.png", 10, (12, 16))
    for n in range(1, 5):
        write_image(tmp_path / f"{n}.png", 10 + n, (48, 64))
    for options in ({}, {"intrinsics": [50, 50, 31.5, 23.5]}):
        found, warnings = opened(tmp_path, **options)
        assert [item.image.shape[:2] for item in found] == 5 * [(48, 64)]
        assert "images scaled to the size of the others: 1 (first: 0.png, 16x12 for 64x48)" in warnings
    np.testing.assert_allclose(found[0].intrinsics, [50, 50, 31.5, 23.5])
    np.testing.assert_allclose(found[1].intrinsics, [50, 50, 31.5, 23.5])


@pytest.mark.parametrize("turned", [(0, 1), (1, 2), (0, 1, 2)])
def test_upright_and_lying_photographs_of_one_camera_are_all_read(turned: tuple[int, ...], tmp_path: Path) -> None:
    for n in range(4):
        photograph(tmp_path / f"{n}.jpg", {EQUIVALENT: 26}, orientation=6 if n in turned else 1)
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(255 * (np.arange(64)[None].repeat(48, 0) > 20).astype(np.uint8)).save(
            tmp_path / f"masks/{n}.png"
        )
    found, warnings = opened(tmp_path)
    assert [item.image.shape[:2] for item in found] == 4 * [(48, 64)]
    assert len({tuple(item.intrinsics) for item in found}) == 1
    for item in found:
        assert item.image[:, 40:].min() > 150 > 50 > item.image[:, :24].max(), "none is turned"
        assert item.mask is not None
        assert item.mask[:, 21:].all()
        assert not item.mask[:, :20].any()
    assert sum("EXIF turns some of the images by a quarter" in w for w in warnings) == 1
    given, _ = opened(tmp_path, intrinsics=[50, 51, 31, 23])
    assert len(given) == 4
    np.testing.assert_allclose(given[0].intrinsics, [50, 51, 31, 23])


def test_turned_photographs_beside_smaller_ones_that_are_not(tmp_path: Path) -> None:
    for n in range(6):
        photograph(tmp_path / f"{n}.jpg", orientation=6 if n < 4 else 1, size=(48, 64) if n < 4 else (24, 32))
    for options in ({}, {"intrinsics": [50, 51, 31, 23]}, {"intrinsics": "auto"}):
        found, warnings = opened(tmp_path, **options)
        assert [item.image.shape[:2] for item in found] == 6 * [(48, 64)]
        assert any("EXIF turns some" in w and "evaluator.camera_up=true is not for them" in w for w in warnings)


@pytest.mark.parametrize("few", [1, 6])
def test_few_that_were_held_otherwise_are_read_too(few: int, tmp_path: Path) -> None:
    for n in range(9):
        photograph(tmp_path / f"{n}.jpg", {EQUIVALENT: 26} if n == 8 else {}, orientation=few if n == 8 else 7 - few)
    found, _ = opened(tmp_path)
    assert [item.image.shape[:2] for item in found] == 9 * [(48, 64)]


def test_an_exif_focal_length_of_a_picture_held_otherwise_is_not_that_of_all(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    for n in range(9):
        photograph(tmp_path / f"{n}.jpg", {EQUIVALENT: 26} if n == 8 else {}, orientation=1 if n == 8 else 6)
        Image.fromarray(np.full((64, 48), 255, np.uint8)).save(tmp_path / f"masks/{n}.png")  # of upright ones
    found, _ = opened(tmp_path)
    assert [item.image.shape[:2] for item in found] == 8 * [(64, 48)]


@pytest.mark.parametrize("lying", [1, 3])
@pytest.mark.parametrize("what", ["intrinsics", "mask", "masks"])
def test_what_is_given_for_upright_photographs_keeps_them_upright(what: str, lying: int, tmp_path: Path) -> None:
    photos, options = tmp_path / "photos", {}
    for n in range(9):
        photograph(photos / f"{n}.jpg", orientation=1 if n >= 9 - lying else 6)
    mask = Image.fromarray((255 * (np.arange(64) > 20)[:, None].repeat(48, 1)).astype(np.uint8))
    if what == "intrinsics":
        options = {"intrinsics": [50, 50, 23, 31]}
    elif what == "mask":
        mask.save(tmp_path / "mask.png")
        options = {"mask": tmp_path / "mask.png"}
    else:
        (photos / "masks").mkdir()
        for n in range(9):
            mask.save(photos / f"masks/{n}.png")
    found, _ = opened(photos, **options)
    assert [item.image.shape[:2] for item in found] == (9 - lying) * [(64, 48)]
    if what == "intrinsics":
        np.testing.assert_allclose(found[0].intrinsics, [50, 50, 23, 31])
    else:
        assert found[0].mask is not None
        assert found[0].mask[21:].all()
        assert not found[0].mask[:20].any()


def test_turned_photographs_beside_a_file_that_does_not_say_their_size(tmp_path: Path) -> None:
    """A model is of images as they are on disk."""
    for n in range(3):
        photograph(tmp_path / "images" / f"{n}.jpg", orientation=6)
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{n}.jpg", "transform_matrix": pose} for n in range(3)]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames}))
    found, warnings = opened(tmp_path)
    assert [item.image.shape[:2] for item in found] == 3 * [(48, 64)]
    np.testing.assert_allclose(found[0].intrinsics, [32, 32, 31.5, 23.5])
    assert warnings == []


def test_k4_of_a_pinhole_is_refused(tmp_path: Path) -> None:
    """It is nerfstudio's, of r^8, and not OpenCV's, whose k4 divides."""
    photograph(tmp_path / "0.jpg")
    content = {"fl_x": 50.0, "k4": 0.01, "frames": [{"file_path": "0.jpg", "transform_matrix": np.eye(4).tolist()}]}
    for model, refused in (("OPENCV", True), ("OPENCV_FISHEYE", False)):
        (tmp_path / "transforms.json").write_text(json.dumps(content | {"camera_model": model}))
        if refused:
            with pytest.raises(ValueError, match=r"k4=0.01 of a camera that is no fisheye is not supported"):
                open_dataset("images", path=tmp_path)
        else:
            assert open_dataset("images", path=tmp_path).lens.distortion[3] == 0.01


def test_a_focal_length_of_another_size_of_the_picture_is_not_taken(tmp_path: Path) -> None:
    """An editor scaled it from 640 to 64 pixels and wrote the new size: the sensor would have a tenth of its width."""
    scaled = {FOCAL: 4.5, RESOLUTION: 1600.0, UNIT: 3, WIDTH: 64, HEIGHT: 48, EQUIVALENT: 38}
    path = photograph(tmp_path / "a.jpg", scaled)
    lens = read_exif_lens(path)
    assert lens is not None
    np.testing.assert_allclose(lens.intrinsics[0], 38 * 80 / np.hypot(36, 24))
    for options in ({}, {"intrinsics": "auto"}):
        warnings = open_dataset("images", path=tmp_path, **options).warnings
        assert any("EXIF of a.jpg contradicts itself" in w and "is taken, 70" in w for w in warnings)
    del scaled[EQUIVALENT]
    assert read_exif_lens(photograph(path, scaled)) is None  # five degrees across
    assert read_exif_lens(photograph(path, {EQUIVALENT: 400})) is not None, "a long lens that says so"
    warnings = open_dataset("images", path=tmp_path).warnings
    assert not any("contradicts" in w for w in warnings)
    photograph(path, scaled)
    warnings = open_dataset("images", path=tmp_path).warnings
    assert any("EXIF of a.jpg names a focal length of 720 pixels, 5.1 degrees across" in w for w in warnings)


def test_a_cropped_picture_has_the_focal_length_of_its_sensor(tmp_path: Path) -> None:
    """The middle of a picture of 96x64: an editor wrote its new size, and left what is of the whole sensor."""
    cropped = {FOCAL: 24.0, RESOLUTION: 96 / 36 * 10, UNIT: 3, WIDTH: 64, HEIGHT: 64, EQUIVALENT: 24}
    lens = read_exif_lens(photograph(tmp_path / "a.jpg", cropped, size=(64, 64)))
    assert lens is not None
    np.testing.assert_allclose(lens.intrinsics[0], 64.0)
    warnings = open_dataset("images", path=tmp_path).warnings
    assert any("EXIF of a.jpg contradicts itself" in w and "64 pixels, which is taken" in w for w in warnings)
    cropped[RESOLUTION] *= 3  # it was scaled, too: no crop leaves so little
    lens = read_exif_lens(photograph(tmp_path / "a.jpg", cropped, size=(64, 64)))
    assert lens is not None
    np.testing.assert_allclose(lens.intrinsics[0], 24 * 64 * np.sqrt(2) / np.hypot(36, 24))


def test_times_of_photographs(tmp_path: Path) -> None:
    zoned = {TAKEN: "2026:05:01 14:00:02", OFFSET: "+02:00", FRACTION: "25 "}
    found = read_exif_time(photograph(tmp_path / "a.jpg", zoned))
    assert found is not None
    assert found.isoformat() == "2026-05-01T14:00:02.250000+02:00"
    for offset in ("", "   :  ", "\0"):
        local = read_exif_time(photograph(tmp_path / "a.jpg", {TAKEN: "2026:05:01 14:00:02", OFFSET: offset}))
        assert local is not None
        assert local.isoformat() == "2026-05-01T14:00:02"
    for wrong in ("0000:00:00 00:00:00", "    :  :     :  :  ", "yesterday"):
        assert read_exif_time(photograph(tmp_path / "a.jpg", {TAKEN: wrong})) is None
    assert read_exif_time(photograph(tmp_path / "a.jpg")) is None


def chunks_of(png: bytes) -> list[bytes]:
    found, at = [], 8
    while at < len(png):
        end = at + 12 + int.from_bytes(png[at : at + 4])
        found.append(png[at:end])
        at = end
    return found


@pytest.mark.parametrize("after", [False, True])
def test_the_header_of_a_png_is_read_without_its_pixels(after: bool, tmp_path: Path) -> None:
    """It may come after them. They are damaged here, so that decoding them would fail."""
    path = tmp_path / "a.png"
    header = Image.Exif()
    header[0x0112] = 6
    header.get_ifd(0x8769).update({EQUIVALENT: 26, TAKEN: "2026:05:01 14:00:02", 0x829A: 0.5, 0x829D: 2.0, 0x8827: 80})
    header.get_ifd(0x8825).update({1: "N", 2: (47.0, 0.0, 0.0), 3: "E", 4: (8.0, 0.0, 0.0)})
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(path, exif=header)
    content = path.read_bytes()
    chunks = {chunk[4:8]: chunk for chunk in chunks_of(content)}
    pixels = chunks[b"IDAT"][:8] + bytes(len(chunks[b"IDAT"]) - 8)
    order = [pixels, chunks[b"eXIf"]] if after else [chunks[b"eXIf"], pixels]
    path.write_bytes(content[:8] + b"".join([chunks[b"IHDR"], *order, chunks[b"IEND"]]))
    lens, taken, place = read_exif_lens(path), read_exif_time(path), read_exif_place(path)
    assert lens is not None
    np.testing.assert_allclose(lens.intrinsics[0], 26 * 80 / np.hypot(36, 24))
    assert lens.size == (64, 48)
    assert taken is not None
    assert taken.isoformat() == "2026-05-01T14:00:02"
    assert read_exif_exposure(path) == 10.0
    assert place is not None
    assert place[:2].tolist() == [47, 8]
    with opened_image(path, path.name) as opened:
        assert upright_size(opened) == (64, 48)


def test_a_folder_of_png_is_opened_without_decoding_it_and_each_frame_is_decoded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photos(tmp_path, 12)
    decoded = list[str]()
    load = ImageFile.ImageFile.load

    def counted(image: ImageFile.ImageFile) -> object:
        if image.tile:
            decoded.append(str(image.filename))
        return load(image)

    monkeypatch.setattr(ImageFile.ImageFile, "load", counted)
    sequence = open_dataset("images", path=tmp_path)
    assert decoded == []
    assert len(list(sequence)) == 12
    assert len(decoded) == 12


def track(folder: Path) -> Path:
    """Twenty seconds from 12:00:00 UTC, at one thousandth of a degree each."""
    points = "".join(
        f'<trkpt lat="{47 + n / 1000}" lon="8"><ele>{n}</ele><time>2026-05-01T12:00:{n:02d}Z</time></trkpt>'
        for n in range(20)
    )
    (folder / "walk.gpx").write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    return folder / "walk.gpx"


def test_a_track_places_photographs_by_when_they_were_taken(tmp_path: Path) -> None:
    gpx, photos = track(tmp_path), tmp_path / "photos"
    for n, second in enumerate((2, 9, 5)):
        photograph(photos / f"{n}.jpg", {TAKEN: f"2026:05:01 14:00:{second:02d}", OFFSET: "+02:00"})
    photograph(photos / "3.jpg")
    found, warnings = opened(photos, gps=gpx)
    np.testing.assert_allclose([item.place[2] for item in found[:3] if item.place is not None], [2, 9, 5])
    assert found[3].place is None
    assert "photographs whose EXIF does not say when they were taken: 1 (first: 3.jpg)" in warnings
    assert any("taken to be of 2026-05-01T14:00:02+02:00, as the file says" in w for w in warnings)


def test_a_cameras_clock_without_a_zone_asks_for_it(tmp_path: Path) -> None:
    gpx, photos = track(tmp_path), tmp_path / "photos"
    for n, second in enumerate((2, 9)):
        photograph(photos / f"{n}.jpg", {TAKEN: f"2026:05:01 14:00:{second:02d}"})
    with pytest.raises(ValueError, match=r"set dataset.gps_start=2026-05-01T14:00:02\+02:00, the time of 0.jpg"):
        open_dataset("images", path=photos, gps=gpx)
    for start, places in (("2026-05-01T14:00:02+02:00", [2, 9]), ("2026-05-01T12:00:05Z", [5, 12])):
        found, _ = opened(photos, gps=gpx, gps_start=start)
        np.testing.assert_allclose([item.place[2] for item in found if item.place is not None], places)


def test_photographs_without_times_beside_a_track_are_refused(tmp_path: Path) -> None:
    photograph(tmp_path / "photos/0.jpg")
    with pytest.raises(ValueError, match=r"for photographs give a \.csv with their names and places; for frames of a"):
        open_dataset("images", path=tmp_path / "photos", gps=track(tmp_path))
