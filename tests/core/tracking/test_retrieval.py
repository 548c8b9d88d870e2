"""Retrieval by appearance: the keyframe that shares rare words, of made descriptors and of images."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.tracking.places.retrieval import Retrieval
from tests.support.true_maps import image


def descriptors(random: np.random.Generator, count: int = 300) -> np.ndarray:
    return random.integers(0, 256, (count, 32), np.uint8)


def noisy(made: np.ndarray, random: np.random.Generator, bits: int = 8) -> np.ndarray:
    """The same corners seen again: so many of the 256 bits of each are another."""
    flipped = np.unpackbits(made, axis=1)
    for row in flipped:
        row[random.choice(256, bits, replace=False)] ^= 1
    return np.packbits(flipped, axis=1)


def made() -> tuple[Retrieval, list[np.ndarray], np.random.Generator]:
    """Ten keyframes, 0, 10, ..., 90, of which each half shows what all others show too."""
    random = np.random.default_rng(0)
    common = descriptors(random)
    places = [np.concatenate([descriptors(random), noisy(common, random)]) for _ in range(10)]
    retrieval = Retrieval()
    for n, place in enumerate(places):
        retrieval.add(10 * n, place)
    return retrieval, places, random


def test_the_keyframe_that_shares_rare_words_is_first() -> None:
    retrieval, places, random = made()
    for n, place in enumerate(places):
        assert retrieval.query(noisy(place, random), 1, set()) == [10 * n]


def test_at_most_so_many_are_returned_and_none_that_is_excluded() -> None:
    retrieval, places, random = made()
    again = noisy(places[4], random)
    assert len(retrieval.query(again, 3, set())) == 3
    others = retrieval.query(again, 20, {40})
    assert len(others) == 9
    assert 40 not in others


def test_what_looks_less_than_half_as_much_alike_as_usual_is_no_match() -> None:
    retrieval, places, random = made()
    again = noisy(places[4], random)
    assert retrieval.query(again, 20, {40}, usual={40}) == []
    assert retrieval.query(again, 20, set(), usual={40}) == [40]
    assert len(retrieval.query(again, 20, {40}, usual={50})) == 9


def test_a_query_of_a_large_map_looks_at_its_rarest_words_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """And finds the same: what all keyframes show says nothing of the place."""
    retrieval, places, random = made()
    again = [noisy(place, random) for place in places]
    whole = [retrieval.query(image, 10, set()) for image in again]
    counted: list[int] = []
    bincount = np.bincount
    monkeypatch.setattr(np, "bincount", lambda places, *rest: counted.append(len(places)) or bincount(places, *rest))
    monkeypatch.setattr("mvsgs_core.tracking.places.retrieval.MOST_POSTINGS", 400)
    few = [retrieval.query(image, 10, set()) for image in again]
    assert max(counted) <= 400
    assert [found[0] for found in few] == [found[0] for found in whole]


def test_nothing_is_found_by_an_image_without_features_or_in_an_empty_map() -> None:
    retrieval, places, _ = made()
    assert retrieval.query(np.zeros((0, 32), np.uint8), 3, set()) == []
    assert Retrieval().query(places[0], 3, set()) == []


def test_images_find_the_keyframe_of_their_place() -> None:
    keyframes = range(0, 300, 30)
    retrieval = Retrieval()
    for number in keyframes:
        retrieval.add(number, image(number).features()[1])
    found = [retrieval.query(image(number + 4).features()[1], 1, set())[0] for number in keyframes]
    assert found == list(keyframes)
