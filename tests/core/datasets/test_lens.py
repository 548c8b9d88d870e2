"""Undistortion, framing and the half-pixel convention, against an independently projected scene."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvsgs_core.camera import matrix
from mvsgs_core.datasets.framing import Framing, resize_depth, target_size
from mvsgs_core.datasets.lens import Lens, Undistortion, guess_lens

BARREL = Lens((300.0, 310.0, 158.0, 117.0), (240, 320), (-0.25, 0.06, 0.001, -0.002, 0.0))
FISHEYE = Lens((180.0, 180.0, 160.0, 120.0), (240, 320), (0.05, -0.01, 0.002, 0.0), fisheye=True)


def dots(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """White image with a round dark spot at each subpixel position."""
    v, u = np.mgrid[0 : size[0], 0 : size[1]]
    image = np.full(size, 255.0)
    for x, y in pixels:
        image -= 200.0 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 2.0**2)
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def centers(image: np.ndarray, near: np.ndarray, radius: int = 6) -> np.ndarray:
    """Centers of gravity of the dark spots nearest to given pixels."""
    dark = 255.0 - image[..., 0].astype(np.float64)
    found = []
    for x, y in np.rint(near).astype(int):
        v, u = np.mgrid[y - radius : y + radius + 1, x - radius : x + radius + 1]
        weight = dark[v, u]
        found.append(((weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()))
    return np.array(found)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE])
@pytest.mark.parametrize(("size", "crop"), [(None, None), ((120, 160), None), ((150, 200), 5), (30000, None)])
def test_points_land_where_the_delivered_intrinsics_say(
    lens: Lens, size: tuple[int, int] | int | None, crop: int | None
) -> None:
    rays = np.array([(x, y, 1.0) for x in (-0.3, -0.1, 0.0, 0.25) for y in (-0.2, 0.05, 0.22)])
    k, d, zero = matrix(np.array(lens.intrinsics)), np.array(lens.distortion), np.zeros(3)
    if lens.fisheye:
        seen = cv2.fisheye.projectPoints(rays[:, None], zero, zero, k, d)[0][:, 0]
    else:
        seen = cv2.projectPoints(rays, zero, zero, k, d)[0][:, 0]
    framing = Framing(size, crop)
    image, intrinsics = framing.image(dots(seen, lens.size), lens, framing.size_of(lens.size))
    expected = rays[:, :2] * intrinsics[:2] + intrinsics[2:]
    assert image.shape[:2] == framing.size_of(lens.size)
    assert np.abs(centers(image, expected) - expected).max() < 0.1


def test_depth_follows_the_image_without_averaging() -> None:
    depth = np.zeros((240, 320), dtype=np.float32)
    depth[:, 160:] = 4.0
    depth[120:, :] += 1.0
    framing = Framing((120, 160))
    framed = framing.depth(depth, BARREL, (120, 160))
    assert set(np.unique(framed)) == {0.0, 1.0, 4.0, 5.0}
    picture = np.repeat((50 * depth).astype(np.uint8)[..., None], 3, axis=-1)
    image, _ = framing.image(picture, BARREL, (120, 160))
    agree = np.abs(image[..., 0] - 50 * framed) < 3
    assert agree.mean() > 0.97  # all but the edges, which the image blurs


@pytest.mark.parametrize("lens", [BARREL, Lens((320.0, 320.0, 150.0, 125.0), (240, 320), (0.3, -0.9, 0.0, 0.0, 1.2))])
def test_zoom_leaves_no_empty_pixel_and_is_the_smallest(lens: Lens) -> None:
    white = np.full((240, 320, 3), 255, dtype=np.uint8)
    filled = Undistortion(lens)
    assert filled.image(white).min() == 255
    kept = Undistortion(lens, fill=False)
    np.testing.assert_array_equal(kept.intrinsics, lens.intrinsics)
    zoom = filled.intrinsics[0] / lens.intrinsics[0]
    if kept.image(white).min() < 255:
        assert zoom > 1
        fx, fy, cx, cy = lens.intrinsics
        less = Undistortion(Lens((fx, fy, cx, cy), lens.size, lens.distortion), fill=False)
        less.intrinsics = np.array([fx * (zoom - 0.01), fy * (zoom - 0.01), cx, cy])
        maps = cv2.initUndistortRectifyMap(
            matrix(np.array(lens.intrinsics)), np.array(lens.distortion), np.eye(3), matrix(less.intrinsics),
            (320, 240), cv2.CV_32FC1,
        )  # fmt: skip
        assert cv2.remap(white, *maps, cv2.INTER_LINEAR).min() < 255
    else:
        assert zoom == 1


def test_no_distortion_changes_nothing() -> None:
    lens = guess_lens((240, 320))
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    framed, intrinsics = Framing().image(image, lens, (240, 320))
    np.testing.assert_array_equal(framed, image)
    np.testing.assert_array_equal(intrinsics, lens.intrinsics)
    assert 2 * np.degrees(np.arctan(160 / lens.intrinsics[0])) == pytest.approx(65.0)


def test_sizes() -> None:
    assert target_size(None, (480, 640)) == (480, 640)
    assert target_size([240, 320], (480, 640)) == (240, 320)
    assert target_size(341 * 640, (680, 1200)) == (352, 624)  # about that area, same aspect, multiples of 8
    assert target_size(10**9, (480, 640)) == (480, 640)  # never larger
    for bad in ((1, 2, 3), (0, 10), 3):
        with pytest.raises(ValueError, match="size"):
            target_size(bad, (480, 640))
    with pytest.raises(ValueError, match="crop"):
        Framing(None, -1)


def test_depth_is_sampled_at_pixel_centers() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(1, 12).repeat(3, axis=0)
    np.testing.assert_array_equal(resize_depth(depth, (1, 4))[0], [1, 4, 7, 10])


@pytest.mark.parametrize(
    ("intrinsics", "distortion"),
    [
        ((0, 1, 2, 3), ()),
        ((1, 1, float("nan"), 3), ()),
        ((1, 1, 1, 1), (0.1, 0.2)),
        ((1, 1, 1, 1), (float("inf"),) * 4),
    ],
)
def test_impossible_lenses_are_refused(
    intrinsics: tuple[float, float, float, float], distortion: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match=r"finite|positive|coefficients"):
        Lens(intrinsics, (10, 10), distortion)


def test_a_distortion_that_cannot_be_undone_is_refused() -> None:
    with pytest.raises(ValueError, match="without a border"):
        Undistortion(Lens((100.0, 100.0, 50.0, 50.0), (100, 100), (300.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("distortion", [(), (0.0, 0.0, 0.0, 0.0)])
def test_an_ideal_fisheye_is_undistorted(distortion: tuple[float, ...]) -> None:
    lens = Lens((180.0, 180.0, 160.0, 120.0), (240, 320), distortion, fisheye=True)
    angle = np.array([-0.6, -0.2, 0.5])  # of rays to the right of the optical axis, which it sees at focal * angle
    image = dots(np.stack([160.0 + 180.0 * angle, np.full(3, 120.0)], axis=1), lens.size)
    undistortion = Undistortion(lens, fill=False)
    expected = np.stack([160.0 + 180.0 * np.tan(angle), np.full(3, 120.0)], axis=1)
    assert np.abs(centers(undistortion.image(image), expected) - expected).max() < 0.15
