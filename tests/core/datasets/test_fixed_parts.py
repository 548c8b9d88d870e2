"""What is fixed to the camera is told from the scene by pictures of a camera that moves."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.datasets.fixed_parts import DOUBT, EVERY, WINDOW, FixedParts, _rim
from tests.support.fixed_things import SIZE, WORLD, Draw, bars, frames, hood, logo, mirror, rim, side_bars


@pytest.mark.parametrize("draw", [bars, side_bars, logo, hood, mirror, rim])
def test_it_is_found_and_hardly_more(draw: Draw) -> None:
    parts = FixedParts()
    for n, image in enumerate(frames(2 * EVERY)):
        where = draw(image, n)
        parts.add(image)
    assert parts.mask is not None
    assert (~parts.mask & where).sum() > 0.85 * where.sum()
    assert (~parts.mask & ~where).sum() < 0.1 * where.size
    assert parts.share == pytest.approx(np.mean(~parts.mask))


def test_of_a_scene_alone_nothing_is_and_few_pictures_are_looked_at() -> None:
    parts = FixedParts()
    for image in frames(DOUBT):
        assert not parts.judged
        parts.add(image)
    assert parts.judged
    assert parts.mask is None
    drawn = next(frames(1))
    logo(drawn, 0)
    for _ in range(WINDOW):
        parts.add(drawn)
    assert parts.mask is None


def test_a_camera_that_stands_while_something_walks_by_hides_nothing() -> None:
    parts, still = FixedParts(), next(frames(1))
    for n in range(WINDOW):
        image = still.copy()
        image[40:90, (5 * n) % 110 :][:, :50] = 240 * (n % 2)
        parts.add(image)
    assert parts.mask is None
    for n, image in enumerate(frames(2 * EVERY)):  # then the camera moves
        logo(image, n)
        parts.add(image)
    assert parts.mask is not None


def test_an_edge_along_the_motion_is_of_the_scene() -> None:
    """Of a camera that moves sideways only, rails run through the image as if they were fixed."""
    parts = FixedParts()
    for n in range(WINDOW):
        image = WORLD[100 : 100 + SIZE[0], 4 * n : 4 * n + SIZE[1]].copy()
        image[50:54] = image[70:74] = 250
        parts.add(image)
    assert parts.mask is None


def test_a_pause_of_the_camera_says_nothing() -> None:
    parts = FixedParts()
    for image in [*frames(5)][-1:] * (3 * WINDOW):
        parts.add(image)
    assert not parts.judged
    assert parts.mask is None


def test_what_goes_away_is_no_longer_masked() -> None:
    parts = FixedParts()
    for n, image in enumerate(frames(4 * WINDOW)):
        if n < WINDOW:
            hood(image, n)
        parts.add(image)
        if n == WINDOW - 1:
            assert parts.mask is not None
    assert parts.mask is None


def test_pictures_of_another_size_begin_anew() -> None:
    parts = FixedParts()
    for n, image in enumerate(frames(EVERY)):
        side_bars(image, n)
        parts.add(image)
    assert parts.mask is not None
    parts.add(np.zeros((60, 80, 3), np.uint8))
    assert parts.mask is None
    assert not parts.judged


def test_black_that_is_no_rim_is_of_the_scene() -> None:
    """A black floor, a post, and all but a lamp in the dark."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    floor, post, dark = y > 0.6 * x + 60, (abs(x - 40) < 6) & (y > 20), (y - 60) ** 2 + (x - 80) ** 2 > 30**2
    for black in (floor, post, dark):
        pictures = [np.where(black[..., None], np.uint8(0), image) for image in frames(EVERY)]
        assert not _rim(np.stack([picture[..., 1] for picture in pictures]).astype(np.float32)).any()
