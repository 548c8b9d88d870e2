"""Masks as people have them: found, brought to the image's size, and refused where they cannot be its mask."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mvsgs_core.datasets import Item, check, open_dataset
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.masks import CameraMask, read_mask
from tests.support.dataset_folders import HEIGHT, WIDTH, write_image, write_photos, write_tum

LEFT = np.arange(WIDTH)[None].repeat(HEIGHT, 0) >= WIDTH // 2  # the left half is ignored


def write_mask(path: Path, mask: np.ndarray = LEFT, white: int = 255) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((white * mask).astype(np.uint8)).save(path)
    return path


def items_of(path: Path, **options: object) -> tuple[list[Item], list[str]]:
    sequence = open_dataset("images", path=path, **options)
    return list(sequence), sequence.warnings


@pytest.mark.parametrize(
    "name", ["masks/photo{}.png", "masks/photo{}.jpg.png", "images/photo{}.jpg.png", "mask/photo{}.png"]
)
def test_masks_of_colmap_and_nerfstudio(tmp_path: Path, name: str) -> None:
    write_photos(tmp_path / "images", 3, ".jpg")
    for i in range(2):
        write_mask(tmp_path / name.format(i), white=1)  # all but 0 counts
    found, warnings = items_of(tmp_path)
    assert len(found) == 3
    for item in found[:2]:
        assert item.mask is not None
        assert item.mask.dtype == np.bool_
        np.testing.assert_array_equal(item.mask, LEFT)
    assert found[2].mask is None
    assert "images without a mask, of which every pixel counts: 1 (first: photo2.jpg)" in warnings


def test_masks_in_subfolders_and_those_that_a_model_names(tmp_path: Path) -> None:
    frames = []
    for i, name in enumerate(("left/0", "right/0")):
        write_image(tmp_path / f"all/{name}.png", 20 + i)
        write_mask(tmp_path / f"all/masks/{name}.png", LEFT if i == 0 else ~LEFT)
        write_mask(tmp_path / f"all/people/{i}.png", ~LEFT if i == 0 else LEFT)
        pose = np.eye(4).tolist()
        frames.append({"file_path": f"{name}.png", "mask_path": f"people/{i}.png", "transform_matrix": pose})
    photos = tmp_path / "photos"
    (tmp_path / "all/people").rename(photos.parent / "people")
    found, _ = items_of(tmp_path / "all")
    assert len(found) == 2
    for item, mask in zip(found, (LEFT, ~LEFT)):
        np.testing.assert_array_equal(item.mask, mask)
    (photos.parent / "people").rename(tmp_path / "all/masks/people")
    for frame in frames:
        frame["mask_path"] = f"masks/{frame['mask_path']}"
    (tmp_path / "all/transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    for item, mask in zip(items_of(tmp_path / "all")[0], (~LEFT, LEFT)):
        np.testing.assert_array_equal(item.mask, mask)
    for file in (tmp_path / "all/masks/people").iterdir():
        file.unlink()
    with pytest.raises(FileNotFoundError, match="not one of the masks"):
        check("images", path=tmp_path / "all")


def test_one_mask_for_all_frames_of_any_reader(tmp_path: Path) -> None:
    write_tum(tmp_path / "rgbd_dataset_freiburg1_x")
    mask = write_mask(tmp_path / "gripper.png", np.kron(LEFT, np.ones((2, 2), bool)))  # twice as large
    found = list(open_dataset("tum", path=tmp_path / "rgbd_dataset_freiburg1_x", mask=mask, crop=0))
    assert found
    assert all(item.mask is not None and 0.4 < item.mask.mean() < 0.6 for item in found)
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    for i in range(3):
        video.write(np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8))
    video.release()
    filmed = list(open_dataset("video", path=tmp_path / "a.avi", intrinsics="auto", mask=mask, size=[24, 32]))
    assert len(filmed) == 3
    for item in filmed:
        assert item.mask is not None
        np.testing.assert_array_equal(item.mask, LEFT[::2, ::2])


def test_a_mask_goes_through_the_lens_with_its_image() -> None:
    """A bright disk on black: what is bright counts, before and after undistortion, crop and size."""
    lens = Lens((50.0, 50.0, 31.5, 23.5), (48, 64), (-0.2, 0.05, 0.0, 0.0))
    v, u = np.mgrid[:48, :64]
    disk = (u - 40) ** 2 + (v - 20) ** 2 < 144
    for framing, size in ((Framing(), (48, 64)), (Framing([24, 32]), (24, 32)), (Framing([40, 56], crop=4), (40, 56))):
        image, _ = framing.image(np.repeat(disk[..., None] * np.uint8(255), 3, 2), lens, size)
        mask = framing.mask(disk, lens, size)
        assert mask.shape == size
        assert (mask == (image[..., 0] > 127)).mean() > 0.97
        assert 0.02 < mask.mean() < 0.3


def test_what_can_be_no_mask_is_refused_before_a_process_starts(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 3)
    write_mask(tmp_path / "photos/masks/other.png")
    with pytest.raises(ValueError, match=r"has no mask of any image: that of photo0.png would be photo0.png.png or"):
        check("images", path=tmp_path / "photos")
    (tmp_path / "photos/masks/other.png").unlink()
    with pytest.raises(ValueError, match="has no mask of any image"):  # empty
        check("images", path=tmp_path / "photos")
    (tmp_path / "photos/masks").rmdir()
    black, square = write_mask(tmp_path / "black.png", 0 * LEFT), write_mask(tmp_path / "square.png", LEFT[:, :48])
    (tmp_path / "text.png").write_text("no image")
    given = [(black, "all black"), (square, "a mask has its image's size"), (tmp_path / "text.png", "text.png")]
    for path, said in [*given, (tmp_path / "none.png", "is missing")]:
        with pytest.raises((ValueError, FileNotFoundError), match=said):
            check("images", path=tmp_path / "photos", mask=path)
    white = write_mask(tmp_path / "white.png", LEFT | True)
    assert any("no black pixel" in line for line in items_of(tmp_path / "photos", mask=white)[1])


def test_images_whose_masks_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    write_photos(tmp_path, 5)
    masks = [LEFT, 0 * LEFT, LEFT[:, :48], LEFT | True, LEFT]
    for i, mask in enumerate(masks):
        write_mask(tmp_path / f"masks/photo{i}.png", mask)
    (tmp_path / "masks/photo4.png").write_bytes(b"damaged")
    found, warnings = items_of(tmp_path)
    assert [item.image[0, 0, 0] for item in found] == [20, 23]
    assert found[1].mask is None  # all white
    assert any(
        line.startswith("images left out because of their masks: 3 (first: photo1.png leaves no") for line in warnings
    )


def test_what_is_transparent_is_ignored_where_there_is_no_mask(tmp_path: Path) -> None:
    """As of objects that were cut out, and of NeRF's own sets."""
    for i, alpha in enumerate((LEFT, LEFT | True, 0 * LEFT)):
        cut = np.full((HEIGHT, WIDTH, 4), 20 + i, np.uint8)
        cut[..., 3] = 255 * alpha
        Image.fromarray(cut).save(tmp_path / f"photo{i}.png")
    found, warnings = items_of(tmp_path)
    assert [item.image[0, 0, 0] for item in found] == [20, 21, 22]
    np.testing.assert_array_equal(found[0].mask, LEFT)
    assert [item.mask for item in found[1:]] == [None, None]
    (told,) = (line for line in warnings if "transparent everywhere" in line)
    assert told.endswith("no mask: every pixel counts: 1 (first: photo2.png)")
    write_mask(tmp_path / "masks/photo0.png", ~LEFT)
    found, _ = items_of(tmp_path)
    np.testing.assert_array_equal(found[0].mask, ~LEFT)
    palette = Image.new("P", (WIDTH, HEIGHT))
    palette.putpalette([9, 9, 9, 7, 7, 7])
    palette.paste(1, (WIDTH // 2, 0, WIDTH, HEIGHT))
    (tmp_path / "palette/images").mkdir(parents=True)
    palette.save(tmp_path / "palette/images/0.png", transparency=0)
    np.testing.assert_array_equal(items_of(tmp_path / "palette")[0][0].mask, LEFT)


def test_a_lossy_mask_is_black_where_it_is_nearly(tmp_path: Path) -> None:
    path = tmp_path / "mask.jpg"
    Image.fromarray(np.where(LEFT, 250, 6).astype(np.uint8)).save(path)
    np.testing.assert_array_equal(read_mask(path), LEFT)
    with pytest.raises(ValueError, match="leaves nothing"):
        CameraMask(write_mask(tmp_path / "rim.png", (np.arange(WIDTH) < 2) & LEFT | (np.arange(WIDTH) < 2))).framed(
            Framing(crop=4), Lens((50.0, 50.0, 31.5, 23.5), (HEIGHT, WIDTH)), (HEIGHT - 8, WIDTH - 8)
        )


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("a.tif", np.float32([0, 0.2, 0.5, 1])),
        ("a.png", np.uint8([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4]])),
        ("a.png", np.uint8([[0, 255], [1, 255], [2, 255], [4, 255]])),  # with an alpha channel
        ("a.png", np.uint16([0, 1, 200, 65535])),
    ],
)
def test_all_but_0_counts_however_small(tmp_path: Path, name: str, values: np.ndarray) -> None:
    Image.fromarray(values[None]).save(tmp_path / name)
    assert read_mask(tmp_path / name).tolist() == [[False, True, True, True]]
