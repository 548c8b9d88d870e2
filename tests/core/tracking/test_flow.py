"""The flows on images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvsgs_core import native
from mvsgs_core.tracking.image import BORDER, TrackingImage
from mvsgs_core.tracking.matching.flow import (
    DenseInverseSearch,
    FeatureFlow,
    LucasKanade,
    make_flow,
    propagate,
    sample_field,
)

SIZE = (240, 320)


def texture(seed: int = 0, sigma: float = 2.0) -> np.ndarray:
    """Noise in four octaves, from `sigma` pixels up: texture on every level of a pyramid, as in photographs."""
    random = np.random.default_rng(seed)
    image = np.zeros((SIZE[0] + 80, SIZE[1] + 80), np.float32)
    for octave in range(4):
        noise = cv2.GaussianBlur(random.normal(0.0, 1.0, image.shape).astype(np.float32), (0, 0), sigma * 2**octave)
        image += noise / noise.std()
    return np.asarray(127.0 + 50.0 * image / image.std())


def shifted(image: np.ndarray, du: float, dv: float, offset: float = 0.0, gain: float = 1.0) -> TrackingImage:
    matrix = np.array([[1.0, 0.0, du - 40.0], [0.0, 1.0, dv - 40.0]])
    moved = gain * cv2.warpAffine(image, matrix, (SIZE[1], SIZE[0]), flags=cv2.INTER_CUBIC) + offset
    return TrackingImage(0, 0.0, np.clip(np.rint(moved), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.3), (5.3, 2.6), (-11.2, 9.7)])
def test_lucas_kanade_finds_subpixel_shifts(shift: tuple[float, float]) -> None:
    a, b = shifted(texture(), 0.0, 0.0), shifted(texture(), *shift)
    points = a.cells.points
    matches = LucasKanade().match(a, b, points, points.astype(np.float64))
    inside = np.all((points + shift > 12) & (points + shift < [SIZE[1] - 13, SIZE[0] - 13]), axis=1)
    assert matches.alive[inside].mean() > 0.9
    error = np.linalg.norm(matches.target - points - shift, axis=1)[inside & matches.alive]
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.99) < 0.3


def test_a_brightness_offset_changes_nothing() -> None:
    a, b = shifted(texture(), 0.0, 0.0), shifted(texture(), 2.0, 1.0, offset=25.0)
    points = a.cells.points
    matches = LucasKanade().match(a, b, points, points.astype(np.float64))
    error = np.linalg.norm(matches.target - points - (2.0, 1.0), axis=1)[matches.alive]
    assert matches.alive.mean() > 0.9
    assert np.median(error) < 0.05


@pytest.mark.parametrize(("gains", "offset"), [((0.9, 0.27), 0.0), ((0.9, 0.45), 40.0), ((0.4, 1.0), 0.0)])
def test_nor_does_a_gain(gains: tuple[float, float], offset: float) -> None:
    """Of an exposure that jumps by more than a stop, brighter or darker."""
    a, b = (shifted(texture(), 2.5 * k, 1.4 * k, k * offset, gain) for k, gain in enumerate(gains))
    points = a.cells.points
    matches = LucasKanade().match(a, b, points, points.astype(np.float64))
    error = np.linalg.norm(matches.target - points - (2.5, 1.4), axis=1)[matches.alive]
    assert matches.alive.mean() > 0.9
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.2


def test_another_image_is_not_found() -> None:
    a, b = shifted(texture(0), 0.0, 0.0), shifted(texture(1), 0.0, 0.0)
    points = a.cells.points
    assert (
        LucasKanade().match(a, b, points, points.astype(np.float64)).alive.mean() < 0.15
    )  # by chance: no pose explains them


def test_points_that_leave_the_image_or_have_no_guess_are_lost() -> None:
    a, b = shifted(texture(), 0.0, 0.0), shifted(texture(), 30.0, 0.0)
    points = np.array([[310.0, 120.0], *[[100.0, 100.0]] * 8])
    wild = [
        [np.nan, np.nan],
        [3e9, 100.0],
        [100.0, 1e38],
        [-1e38, 100.0],
        [np.inf, 100.0],
        [100.0, -np.inf],
        [1e300, 0],
    ]
    guess = np.array([[340.0, 120.0], *wild, [130.0, 100.0]])
    matches = LucasKanade().match(a, b, points, guess)
    np.testing.assert_array_equal(matches.alive, [False] * 8 + [True])
    assert np.isnan(matches.target[:8]).all()


@pytest.mark.parametrize("far", [3e9, 1e38, np.inf, -np.inf, np.nan])
def test_the_kernel_reads_nothing_outside_an_image_for_any_guess(far: float) -> None:
    image = shifted(texture(), 0.0, 0.0)
    found = native.load("tracking").lucas_kanade(
        a=image.pyramid,
        b=image.pyramid,
        points=np.full((2, 2), 100.0, np.float32),
        guess=np.array([[far, 100.0], [100.0, far]], np.float32),
        border=BORDER,
        start_level=2,
        iterations=10,
        window_sigma=4.0,
        min_eigenvalue=1.0,
        threads=1,
    )
    assert np.isinf(found[:, 2]).all(), "lost"


def test_flat_cells_are_not_textured() -> None:
    image = texture()
    image[:, :200] = 127.0
    cells = shifted(image, 0.0, 0.0).cells
    left = cells.points[:, 0] < 140
    assert not cells.textured[left].any()
    assert cells.textured[cells.points[:, 0] > 180].mean() > 0.95


def test_information_follows_the_edge() -> None:
    """A vertical edge says where it is across, and nothing along."""
    image = np.zeros(SIZE, np.uint8)
    image[:, 162:] = 200
    cells = TrackingImage(0, 0.0, image).cells
    on_edge = np.abs(cells.points[:, 0] - 161.5) < 4
    xx, xy, yy = cells.information[on_edge].T
    assert xx.min() > 0.9
    np.testing.assert_allclose(xy, 0.0, atol=1e-9)
    np.testing.assert_allclose(yy, 0.0, atol=1e-9)


@pytest.mark.parametrize(("flow", "shift"), [(DenseInverseSearch(), (4.0, -3.0)), (FeatureFlow(), (45.0, 25.0))])
def test_coarse_flows_come_near(flow: DenseInverseSearch | FeatureFlow, shift: tuple[float, float]) -> None:
    a, b = shifted(texture(2, 3.0), 0.0, 0.0), shifted(texture(2, 3.0), *shift)
    if isinstance(flow, FeatureFlow):  # one epipolar geometry does not tell a pure shift from others: any will do
        shift = (45.0, 25.0)
    points = a.cells.points
    matches = flow.match(a, b, points, points.astype(np.float64))
    inside = np.all((points + shift > 30) & (points + shift < [SIZE[1] - 31, SIZE[0] - 31]), axis=1)
    error = np.linalg.norm(matches.target - points - shift, axis=1)[inside & matches.alive]
    assert matches.alive[inside].mean() > 0.8
    assert np.median(error) < 1.0


@pytest.mark.parametrize("rows", [24, 32, 48, 56])
def test_images_of_few_rows_have_a_flow(rows: int) -> None:
    """OpenCV's ends the process on most of them."""
    first, second = (shifted(texture(2, 3.0), *shift).gray[:rows] for shift in ((0.0, 0.0), (4.0, -2.0)))
    field = DenseInverseSearch().field(TrackingImage(0, 0.0, first.copy()), TrackingImage(1, 0.1, second.copy()))
    assert field.shape == (rows // 2, SIZE[1] // 2, 2)
    np.testing.assert_allclose(np.median(field.reshape(-1, 2), axis=0), [4.0, -2.0], atol=0.5)


def test_propagate_takes_the_median_of_the_nearest() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [100.0, 0.0]])
    displacement = np.array([[1.0, 0.0], [1.0, 0.0], [50.0, 0.0], [7.0, 7.0]])
    queries = np.array([[0.5, 0.5], [99.0, 0.0], [500.0, 0.0]])
    moved = propagate(points, displacement, queries, neighbors=3, radius=10.0)
    np.testing.assert_allclose(moved[:2], [[1.5, 0.5], [106.0, 7.0]])
    assert np.isnan(moved[2]).all()


def test_a_point_that_is_nowhere_is_none() -> None:
    random = np.random.default_rng(1)
    points, displacement, queries = (random.uniform(0.0, 50.0, (n, 2)) for n in (40, 40, 25))
    expected = propagate(points, displacement, queries, radius=20.0)
    for row in (0, 17, 40):
        for nowhere in ([np.nan, np.nan], [np.nan, 3.0], [3.0, np.nan]):
            more = np.insert(points, row, nowhere, axis=0), np.insert(displacement, row, [7.0, 7.0], axis=0)
            np.testing.assert_array_equal(propagate(*more, queries, radius=20.0), expected)
        more = np.insert(points, row, [25.0, 25.0], axis=0), np.insert(displacement, row, np.nan, axis=0)
        np.testing.assert_array_equal(propagate(*more, queries, radius=20.0), expected)


def test_lists_of_points_that_differ_in_length_are_refused() -> None:
    image = shifted(texture(), 0.0, 0.0)
    points = image.cells.points
    for guess in (points[:-1], points[:, :1], points.ravel()):
        with pytest.raises(ValueError, match="of one length"):
            LucasKanade().match(image, image, points, guess)
    with pytest.raises(ValueError, match="of one length"):
        LucasKanade().match(image, image, points.ravel(), points)
    for displacement, queries in ((points[:-1], points), (points, points.ravel()), (points, points[:, :1])):
        with pytest.raises(ValueError, match="values"):
            propagate(points, displacement, queries)


def test_half_size_fields_are_sampled_at_full_size() -> None:
    v, u = np.mgrid[:8, :10].astype(np.float32)
    field = np.stack([2 * u + 0.5, 2 * v + 0.5], axis=-1)  # the full-size position of each half-size pixel
    points = np.array([[3.0, 4.0], [8.5, 6.5]])
    np.testing.assert_allclose(sample_field(field, points), points, atol=0.05)


def test_unknown_flows_are_refused() -> None:
    with pytest.raises(ValueError, match="lucas_kanade"):
        make_flow("raft")
