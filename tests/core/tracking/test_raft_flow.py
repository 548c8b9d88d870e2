"""RAFT-small behind the tracker's flow interface, with its published weights."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.flow import Flow, make_flow
from mvsgs_core.tracking.matching.raft_flow import RaftFlow, _sample, refined_raft
from tests.support.shared_data import shared

SHIFT = np.array([21.0, -13.0])


def pair() -> tuple[TrackingImage, TrackingImage]:
    """A texture and the same texture, moved by SHIFT."""
    coarse = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    texture = np.kron(coarse, np.ones((6, 6, 1), np.uint8))
    x, y = SHIFT.astype(int)
    first, second = texture[30:158, 40:232], texture[30 - y : 158 - y, 40 - x : 232 - x]
    return tuple(TrackingImage.of(n, 0.0, i.copy(), (128, 192), True) for n, i in enumerate((first, second)))  # type: ignore[return-value]


def test_a_flow_is_read_where_the_points_are() -> None:
    """Of a flow that is nearly the same everywhere nobody would see that it is not."""
    v, u = np.mgrid[:40.0, :60.0]
    points = np.random.default_rng(0).uniform(0, [59, 39], (200, 2))
    np.testing.assert_allclose(_sample(np.stack([u, v]).astype(np.float32), points), points, atol=0.05)


@pytest.mark.parametrize(("kind", "allowed"), [(RaftFlow, 0.3), (refined_raft, 0.05)])
def test_finds_a_large_motion_without_a_guess(kind: Callable[..., Flow], allowed: float) -> None:
    flow = kind(weights=str(shared("weights/raft-small.pth")))
    assert flow.needs_color
    a, b = pair()
    v, u = np.mgrid[24:110:9, 8:160:9]
    points = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float32)
    matches = flow.match(a, b, points, points.astype(float))
    assert matches.alive.mean() > 0.8
    errors = np.linalg.norm(matches.target - points - SHIFT, axis=1)[matches.alive]
    assert np.median(errors) < allowed
    assert np.isnan(matches.target[~matches.alive]).all()


def test_a_point_that_leaves_the_image_is_lost() -> None:
    flow = refined_raft(weights=str(shared("weights/raft-small.pth")))
    a, b = pair()
    points = np.array([[185.0, 60.0], [90.0, 3.0], [90.0, 60.0]])
    guess = points + SHIFT
    guess[2] = np.nan  # no guess: the others' motion
    assert flow.match(a, b, points, guess).alive.tolist() == [False, False, True]


def test_missing_weights_and_missing_color_say_what_to_do() -> None:
    with pytest.raises(FileNotFoundError, match="RAFT"):
        make_flow("raft_small", weights="nowhere.pth")
    flow = RaftFlow(weights=str(shared("weights/raft-small.pth")))
    gray = [TrackingImage.of(n, 0.0, np.zeros((64, 64, 3), np.uint8), (64, 64), False) for n in range(2)]
    points = np.full((1, 2), 30.0)
    with pytest.raises(ValueError, match="color"):
        flow.match(gray[0], gray[1], points, points)
