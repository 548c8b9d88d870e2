"""Exposure of every frame: the tracker's, in the map's gauge, with what the map trained for keyframes in between."""

from __future__ import annotations

import numpy as np

from mvsgs_core.evaluation.exposure import frame_exposures, gains, summary
from mvsgs_core.photometry import IDENTITY, compose, inverse

TIMES = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
GAUGE = np.array([[0.8, 0, 0, 0.01], [0, 0.9, 0, 0], [0, 0, 1.1, -0.02]])


def tracked(*brightness: float) -> np.ndarray:
    return np.stack([np.hstack([b * np.eye(3), [[0.01], [0.0], [-0.02]]]) for b in brightness]).astype(np.float32)


def test_a_frame_has_the_trackers_exposure_in_the_gauge_of_the_map() -> None:
    """Not what its neighbors' would be in between: the light was switched at frame 1 alone."""
    measured = tracked(1.0, 0.4, 1.2, 1.1, 1.0)
    rows = np.array([0, 2, 4])
    found = frame_exposures(TIMES, measured, rows, compose(measured[rows], inverse(GAUGE)))
    assert found is not None
    np.testing.assert_allclose(found, compose(measured, inverse(GAUGE)), atol=1e-6)
    assert found.dtype == np.float32


def test_what_the_map_trained_beside_is_linear_in_time_between_keyframes() -> None:
    measured = tracked(1.0, 0.5, 1.0, 2.0, 1.0)
    rows = np.array([1, 3])
    trained = measured[rows].astype(np.float64)
    trained[0, :, :3] *= 1.1
    trained[1, :, :3] *= 0.9
    found = frame_exposures(TIMES, measured, rows, trained)
    assert found is not None
    brightness = gains(found)[:, 0] / gains(measured)[:, 0]
    np.testing.assert_allclose(brightness, [1.1, 1.1, 1.0, 0.9, 0.9], atol=1e-6)
    report = summary(np.array([7, 9]), trained, found, np.array([-0.1, 0, 0]))
    assert report is not None
    assert report["keyframes"] == [7, 9]
    np.testing.assert_allclose(report["gain"], [[0.55] * 3, [1.8] * 3], atol=1e-6)
    assert report["vignetting"] == [-0.1, 0, 0]


def test_of_a_frame_that_the_tracker_does_not_know_its_neighbors_tell() -> None:
    measured = tracked(1.0, 1.0, 1.5, 2.0, 9.0)
    measured[[2, 4]] = np.nan
    found = frame_exposures(TIMES, measured, np.array([0, 3]), measured[[0, 3]])
    assert found is not None
    np.testing.assert_allclose(gains(found)[:, 0], [1.0, 1.0, 1.5, 2.0, 2.0], atol=1e-6)


def test_where_times_go_back_frames_lie_between_by_their_numbers() -> None:
    measured = tracked(1.0, 1.0, 1.5, 2.0, 2.0)
    measured[2] = np.nan
    rows = np.array([1, 3])
    trained = measured[rows].astype(np.float64)
    trained[1, :, :3] *= 1.2
    expected = frame_exposures(TIMES, measured, rows, trained)
    found = frame_exposures(np.array([10.0, 11.0, 0.0, 1.0, 2.0]), measured, rows, trained)
    assert expected is not None
    assert found is not None
    np.testing.assert_array_equal(found, expected)


def test_without_a_tracker_that_knows_the_maps_are_interpolated_and_identities_are_none() -> None:
    rows, plain = np.array([0, 4]), np.stack([IDENTITY, IDENTITY])
    bright = tracked(1.0, 3.0)
    found = frame_exposures(TIMES, None, rows, bright)
    assert found is not None
    np.testing.assert_allclose(gains(found)[:, 1], [1.0, 1.5, 2.0, 2.5, 3.0], atol=1e-6)
    unknown = np.full((5, 3, 4), np.nan, np.float32)
    assert frame_exposures(TIMES, None, rows, plain) is None
    assert frame_exposures(TIMES, unknown, rows, plain) is None
    off = frame_exposures(TIMES, tracked(1.0, 2.0, 1.0, 0.5, 1.0), rows, plain)
    assert off is None  # a map without exposures shows every frame as it is
    assert frame_exposures(TIMES, None, np.zeros(0, int), np.zeros((0, 3, 4))) is None
    assert summary(np.zeros(0), np.zeros((0, 3, 4)), None, None) is None


def test_photographs_in_any_order_have_what_the_nearest_one_has() -> None:
    """Their numbers say nothing, and those of a bracket of exposures are all at one place."""
    measured = tracked(1.0, 2.0, 9.0, 1.5, 5.0)
    measured[2] = np.nan
    centers = np.array([[0.0, 0, 0], [5, 0, 0], [0.1, 0, 0], [0, 0, 0], [np.nan] * 3])
    rows = np.array([0, 1, 3])
    trained = measured[rows].astype(np.float64)
    trained[0, :, :3] *= 1.1
    found = frame_exposures(TIMES, measured, rows, trained, centers)
    assert found is not None
    np.testing.assert_allclose(gains(found)[:4, 0], [1.1, 2.0, 1.1, 1.5], atol=1e-6)
    everywhere = frame_exposures(TIMES, measured, rows, trained, centers[[0, 1, 4, 3, 4]])
    assert everywhere is not None
    assert np.isfinite(everywhere).all()
