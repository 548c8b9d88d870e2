"""An image is split where that saves enough error, and at depth edges: few rectangles where it is smooth."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mvsgs_core import native
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.partition import EMPTY, Partition, Split, partition
from tests.support import partition_plain

SIZE = (48, 64)
PRICE = InsertionConfig().price
ANGLE = 1 / 60.0


def split(
    image: np.ndarray, residual: np.ndarray | float = EMPTY, wanted: np.ndarray | bool = True,
    depth: np.ndarray | float = 2.0, known: np.ndarray | bool = True, price: float = PRICE,
    noise: float = 0.0,
) -> Partition:  # fmt: skip
    size = image.shape[:2]

    def full(value: np.ndarray | float | bool) -> np.ndarray:
        return np.broadcast_to(np.asarray(value), size).copy()

    return partition(image, full(residual), full(wanted), full(depth), full(known), ANGLE, price, noise)


def textured(size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(0).uniform(size=(*size, 3))


@pytest.mark.parametrize("size", [(48, 64), (45, 61)])
def test_the_kernel_finds_what_its_plain_twin_finds(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(2)
    u, v = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    image = 0.5 + 0.4 * np.sin((u / 12.0) ** 2 + v / 15.0)[..., None] * [1.0, 0.8, 0.6]  # finer to the right
    depth = 2.0 + 0.3 * np.sin(np.arange(size[1]) / 9.0)[None] + np.zeros((size[0], 1))
    depth[:, size[1] // 2 :] += 1.0
    known, wanted = random.random(size) < 0.95, (u + v) % 40 > 3
    residual = np.where(v < 20, EMPTY, 0.01 * random.random(size)).astype(np.float32)
    found = partition(image, residual, wanted, depth, known, ANGLE, PRICE)
    given: list[Split] = []

    def plain(threads: int, **values: Any) -> tuple[np.ndarray, np.ndarray]:
        given.append(Split(**values))
        return partition_plain.split(given[0])

    monkeypatch.setattr(native, "load", lambda name: SimpleNamespace(partition=plain))
    twin = partition(image, residual, wanted, depth, known, ANGLE, PRICE)
    assert len(given) == 1
    assert len({*map(tuple, twin.sides.tolist())}) > 8  # of many shapes
    np.testing.assert_array_equal(found.labels, twin.labels)
    np.testing.assert_array_equal(found.sides, twin.sides)


def test_the_kernel_refuses_images_of_no_whole_rectangles() -> None:
    flat, nothing = np.zeros((8, 12), np.float32), np.zeros((8, 12), bool)
    with pytest.raises(ValueError, match="multiples of 8"):
        native.load("mapping").partition(
            np.zeros((8, 12, 3), np.float32), flat, flat, nothing, nothing, np.zeros((8, 12)), 0.1, 0.02, 0.25, 1
        )
    with pytest.raises(ValueError, match="sizes differ"):
        native.load("mapping").partition(
            np.zeros((8, 8, 3), np.float32), flat, flat, nothing, nothing, np.zeros((8, 12)), 0.1, 0.02, 0.25, 1
        )


def test_a_smooth_image_has_few_rectangles_and_a_textured_one_many() -> None:
    ramp = np.broadcast_to(np.linspace(0.2, 0.6, 64)[None, :, None], (*SIZE, 3))
    smooth, rough = split(ramp), split(textured())
    assert 6 * 8 <= len(smooth) < 2 * 6 * 8  # at the border a ramp does not go on
    assert len(rough) > 0.75 * 48 * 64


def test_every_wanted_pixel_that_the_map_does_not_show_is_in_a_rectangle_and_no_other() -> None:
    wanted = np.random.default_rng(1).uniform(size=SIZE) < 0.6
    found = split(np.full((*SIZE, 3), 0.5), wanted=wanted)
    np.testing.assert_array_equal(found.labels >= 0, wanted)


def test_labels_are_rectangles_of_their_sides() -> None:
    image = textured((45, 61))
    image[:, :30] = 0.5  # neither side is a multiple of 8
    found = split(image)
    assert found.labels.shape == (45, 61)
    assert sorted(np.unique(found.labels)) == list(range(len(found)))
    for number, (height, width) in enumerate(found.sides):
        rows, columns = np.nonzero(found.labels == number)
        assert rows.max() < rows.min() // height * height + height
        assert columns.max() < columns.min() // width * width + width
        inside = (min(45, rows.min() + height) - rows.min()) * (min(61, columns.min() + width) - columns.min())
        assert len(rows) == inside


def test_stripes_are_split_across_and_not_along() -> None:
    image = np.zeros((*SIZE, 3))
    image[::2] = 1.0
    found = split(image)
    assert (found.sides[:, 0] == 1).all()
    assert (found.sides[:, 1] == 8).all()


def test_noise_alone_does_not_split() -> None:
    noise = np.random.default_rng(2).normal(0.0, 2.0 / 255.0, (*SIZE, 3))  # two gray levels, as of a camera
    assert len(split(0.5 + noise)) == 6 * 8


@pytest.mark.parametrize("explained", [0.0, 0.1 * PRICE / 64])
def test_what_the_map_shows_well_enough_gets_nothing(explained: float) -> None:
    found = split(textured(), explained)
    assert len(found) == 0
    assert (found.labels == -1).all()
    assert found.sides.shape == (0, 2)


def test_an_error_that_is_worth_its_price_gets_a_splat_there_alone() -> None:
    residual = np.zeros(SIZE)
    residual[8:12, 20:22] = 0.5
    found = split(textured(), residual, price=1.0)
    np.testing.assert_array_equal(found.labels >= 0, residual > 0)
    assert len(split(textured(), residual / 100, price=1.0)) == 0  # a quarter of that in all


def test_a_depth_edge_splits_and_a_slanted_wall_does_not() -> None:
    gray = np.full((*SIZE, 3), 0.5)
    columns = np.arange(64)[None]
    edge = np.where(columns < 29, 2.0, 3.0) + np.zeros(SIZE)
    found = split(gray, depth=edge)
    for number in range(len(found)):
        assert len(np.unique(edge[found.labels == number])) == 1
    assert len(found) > 6 * 8
    wall = 2.0 * np.exp(ANGLE * columns) + np.zeros(SIZE)  # by 45 degrees
    assert len(split(gray, depth=wall)) == 6 * 8
    rough = 2.0 * np.exp(0.015 * np.random.default_rng(0).standard_normal(SIZE))
    assert len(split(gray, depth=rough)) == 6 * 8  # as stereo's noise makes it
    unknown = split(gray, depth=edge, known=columns < 29)  # what is doubtful says nothing of edges
    assert len(unknown) == 6 * 8


def test_low_contrast_is_worth_as_much_as_high() -> None:
    texture = textured() - 0.5
    for price in (0.3, 0.5):
        high, low = (len(split(0.5 + contrast * texture, price=price)) for contrast in (1.0, 0.3))
        assert low == pytest.approx(high, rel=0.1)
        assert 6 * 8 < high < 0.9 * 48 * 64


def test_less_price_is_never_fewer_splats() -> None:
    image = 0.3 * textured() + 0.3
    counts = [len(split(image, 0.01, price=price)) for price in (0.0, 1e-2, 1.0, 100.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 48 * 64
    assert counts[-1] == 0


def test_amid_noise_faint_detail_is_worth_fewer_splats() -> None:
    rng = np.random.default_rng(5)
    image = (0.5 + 0.03 * (textured() - 0.5) + 0.01 * rng.standard_normal((48, 64, 3))).astype(np.float32)
    counts = [len(split(image, noise=sigma**2)) for sigma in (0.0, 0.01, 0.03)]
    assert counts[0] > 1.1 * counts[1] > 1.3 * counts[2] > 0
    sharp = textured()
    assert len(split(sharp, noise=0.01**2)) > 0.95 * len(split(sharp)), "beside high contrast it is nothing"


def test_the_same_image_is_split_alike_and_in_bounded_time() -> None:
    image = textured((480, 640))
    start = time.process_time()
    first = split(image)
    assert time.process_time() - start < 2.0
    second = split(image)
    np.testing.assert_array_equal(first.labels, second.labels)
    np.testing.assert_array_equal(first.sides, second.sides)
