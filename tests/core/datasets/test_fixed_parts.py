"""What is fixed to the camera is told from the scene by pictures of a camera that moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.fixed_parts import DOUBT, EVERY, WINDOW, FixedParts
from mvsgs_core.stats import Stats
from nodes.fixed_mask import AHEAD, FixedMask
from tests.support.sequences import ate, synthetic, track

SIZE = (120, 160)
Draw = Callable[[np.ndarray, int], np.ndarray]  # over an image, in place; where: (H, W) bool


def texture(size: tuple[int, int], seed: int, grain: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(*size, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.clip(120.0 + 60.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)


WORLD = texture((400, 500), 0)


def frames(count: int, step: float = 1.0) -> Iterator[np.ndarray]:
    """A camera that moves sideways and up and down before a textured wall."""
    for n in range(count):
        u, v = 150 + 120 * np.sin(0.11 * n * step), 120 + 90 * np.sin(0.17 * n * step)
        yield cv2.getRectSubPix(WORLD, SIZE[::-1], (u + SIZE[1] / 2, v + SIZE[0] / 2))


def bars(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[:14] = where[-14:] = True
    image[where] = 3
    return where


def side_bars(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[:, :30] = where[:, -30:] = True
    image[where] = 0
    return where


def logo(image: np.ndarray, n: int) -> np.ndarray:
    where = np.zeros(SIZE, bool)
    where[10:30, 20:60] = True
    image[where] = (200, 20, 20)
    cv2.putText(image, "TV", (25, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
    return where


def hood(image: np.ndarray, n: int) -> np.ndarray:
    where = np.arange(SIZE[0])[:, None] > 95 + 0.004 * (np.arange(SIZE[1])[None] - 80) ** 2
    image[where] = texture(SIZE, 1, 4.0)[where] // 2
    return where


def mirror(image: np.ndarray, n: int) -> np.ndarray:
    """A smooth hood, in which a bright scene is seen weakly."""
    image[:] = image // 4 + 130
    where = np.arange(SIZE[0])[:, None] > 80 + 0.006 * (np.arange(SIZE[1])[None] - 80) ** 2
    image[where] = (20 + 0.2 * image[::-1].astype(np.float32))[where].astype(np.uint8)
    return where


@pytest.mark.parametrize("draw", [bars, side_bars, logo, hood, mirror])
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


def items(count: int, draw: Draw | None, **given: object) -> list[Item]:
    found = []
    for n, image in enumerate(frames(count)):
        if draw is not None:
            draw(image, n)
        found.append(Item(n, n / 30.0, image, np.array([100.0, 100.0, 80.0, 60.0]), **given))  # type: ignore[arg-type]
    return found


def test_the_first_frames_of_a_file_have_the_mask_as_well() -> None:
    stats = Stats()
    found = list(FixedMask(stats, True).masked_ahead(items(EVERY + 5, logo)))
    assert [item.index for item in found] == list(range(EVERY + 5))
    assert all(item.mask is not None and not item.mask[[8, 20], 40].any() for item in found)
    assert len([w for w in stats.warnings if "fixed to the camera" in w and "hide_fixed=false" in w]) == 1


def test_a_stream_without_any_waits_for_a_few_frames_only() -> None:
    source = iter(items(AHEAD, None))
    first = next(FixedMask(Stats(), True).masked_ahead(source))
    assert first.mask is None
    assert len(list(source)) == AHEAD - DOUBT


def test_a_still_stream_is_not_kept_for_ever() -> None:
    one = items(1, None)[0]
    source = iter([replace(one, index=n) for n in range(2 * AHEAD)])
    next(FixedMask(Stats(), True).masked_ahead(source))
    assert len(list(source)) == AHEAD


def test_live_frames_have_it_as_soon_as_it_is_known() -> None:
    fixed = FixedMask(Stats(), True)
    found = [fixed.masked(item) for item in items(EVERY + 1, logo)]
    assert found[0].mask is None
    assert found[-1].mask is not None


def test_masks_that_frames_have_stay() -> None:
    own = np.ones(SIZE, bool)
    own[:, :10] = False
    for item in FixedMask(Stats(), True).masked_ahead(items(EVERY, logo, mask=own)):
        assert item.mask is not None
        assert not item.mask[:, :10].any()
        assert not item.mask[20, 40]
        assert item.mask[60, 80]


def test_it_can_be_left() -> None:
    found = list(FixedMask(Stats(), False).masked_ahead(items(WINDOW, logo)))
    assert all(item.mask is None for item in found)


@pytest.mark.slow
def test_bars_beside_a_video_do_not_hold_the_tracker() -> None:
    """Their rims stand still, or slide along what is behind them."""
    shown = []
    for item in synthetic(frames=80):
        image = item.image.copy()
        image[:, :40] = image[:, -40:] = 0
        shown.append(replace(item, image=image))
    found = list(FixedMask(Stats(), True).masked_ahead(shown))
    assert all(item.mask is not None for item in found)
    assert ate(track(found)[1], found)[0] < 0.7 * ate(track(shown)[1], shown)[0]
