"""Features and their matches, and which pairs are proposed."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from mvsgs_core.photographs import matching
from mvsgs_core.photographs.features import Features, find_features
from mvsgs_core.photographs.matching import EXHAUSTIVE, FIRST, likeness, match, near_pairs, propose_pairs
from tests.support.sequences import synthetic


def described(points: np.ndarray, descriptors: np.ndarray) -> Features:
    """Features (N) of one size and direction."""
    return Features(points, descriptors, np.ones(len(points)), np.zeros(len(points)))


def random_features(count: int, seed: int) -> Features:
    random = np.random.default_rng(seed)
    descriptors = np.abs(random.standard_normal((count, 128))).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return described(random.uniform(0, 100, (count, 2)), descriptors)


def shuffled(of: Features, seed: int, noise: float = 0.02) -> tuple[Features, np.ndarray]:
    """The same features in another order; feature n of the result is feature order[n]."""
    random = np.random.default_rng(seed)
    order = random.permutation(len(of.points))
    descriptors = of.descriptors[order] + noise / 11.0 * random.standard_normal((len(order), 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return described(of.points[order], descriptors.astype(np.float32)), order


def test_features_turn_and_grow_with_the_image() -> None:
    image = synthetic(frames=80)[0].image
    turned = np.ascontiguousarray(np.rot90(image))
    here, there = find_features(image, 800), find_features(turned, 800)
    np.testing.assert_allclose(np.linalg.norm(here.descriptors, axis=1), 1.0, atol=1e-3)
    matches = match(here, there)
    a, b = here.points[matches[:, 0]], there.points[matches[:, 1]]
    expected = np.stack([a[:, 1], image.shape[1] - 1 - a[:, 0]], axis=1)
    assert len(matches) > 50
    assert np.mean(np.linalg.norm(b - expected, axis=1) < 1.0) > 0.95


def test_a_dark_photograph_has_the_features_of_a_bright_one() -> None:
    image = synthetic(frames=80)[0].image
    bright, dark = find_features(image, 800), find_features(image // 8, 800)
    assert len(dark.points) > 0.7 * len(bright.points)


def test_an_image_without_texture_has_no_features() -> None:
    found = find_features(np.full((100, 120, 3), 90, np.uint8), 100)
    assert found.points.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)
    assert match(found, found).shape == (0, 2)


def test_matches_are_the_same_features() -> None:
    here = random_features(300, 0)
    there, order = shuffled(here, 1)
    matches = match(here, there)
    assert len(matches) > 290
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])


def test_what_looks_like_two_others_is_no_match() -> None:
    here = random_features(50, 0)
    one, other = shuffled(here, 1)[0], shuffled(here, 2)[0]
    twice = described(np.concatenate([one.points, other.points]), np.concatenate([one.descriptors, other.descriptors]))
    assert len(match(here, twice)) < 5


def test_what_has_no_counterpart_is_no_match() -> None:
    assert len(match(random_features(200, 0), random_features(200, 1))) < 5


def test_pairs_are_those_that_look_alike_and_few_photographs_are_all_paired() -> None:
    count = EXHAUSTIVE + 5
    places = [random_features(FIRST, seed) for seed in range(count)]
    half = [place.descriptors[: FIRST // 2] for place in places]
    around = [described(np.zeros((FIRST, 2)), np.concatenate([half[n], half[n - 1]])) for n in range(count)]
    alike = likeness(around)
    assert alike[3, 4] > 0.4 * FIRST
    assert alike[3, 20] < 5
    np.testing.assert_array_equal(alike, alike.T)
    pairs = propose_pairs(around, 2)
    assert {(n, n + 1) for n in range(count - 1)} <= set(pairs)
    assert len(pairs) <= 2 * count
    assert len(propose_pairs(around[:6], 2)) == 15


def test_each_place_is_matched_with_others_however_often_it_was_photographed() -> None:
    """As bursts, or a camera that rests on a tripod."""
    places = [random_features(FIRST // 2, seed).descriptors for seed in range(5)]
    views = [described(np.zeros((FIRST, 2)), np.concatenate([places[n], places[n + 1]])) for n in range(4)]
    copies = [shuffled(view, 10 * n + k)[0] for n, view in enumerate(views) for k in range(10)]
    pairs = {(i // 10, j // 10) for i, j in propose_pairs(copies, 5)}
    assert {(0, 1), (1, 2), (2, 3)} <= pairs
    assert len(propose_pairs(copies, 5)) <= 5 * len(copies)


def test_many_photographs_are_compared_without_a_list_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    count = 2000
    alike = np.zeros((count, count), np.float32)
    near = np.arange(count - 1)
    alike[near, near + 1] = alike[near + 1, near] = 10.0
    monkeypatch.setattr(matching, "likeness", lambda features: alike)
    tracemalloc.start()
    pairs = propose_pairs([random_features(2, 0)] * count, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert pairs == list(zip(near.tolist(), (near + 1).tolist()))
    assert peak < 60e6  # two million tuples take more


def test_gps_proposes_the_nearest_and_nothing_where_it_is_not_known() -> None:
    places: list[np.ndarray | None] = [np.array([47.0, 8.0 + 1e-4 * n, 400.0]) for n in (0, 5, 1, 9, 6)]
    places.insert(2, None)
    assert near_pairs(places, 1) == [(0, 3), (1, 5), (4, 5)]
    assert len(near_pairs(places, 9)) == 10  # all with all
    assert near_pairs(places, 0) == []
    assert near_pairs([None, None, places[0]], 3) == []
