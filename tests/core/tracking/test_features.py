"""Binary descriptors matched by our kernel, beside OpenCV's matcher."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.matching.features import FARTHEST, RATIO, match_descriptors
from tests.support.sequences import synthetic


def _by_opencv(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    forward = matcher.knnMatch(a, b, k=2)
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in forward
        if best.distance < FARTHEST and best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def test_matches_of_images_are_those_of_opencv() -> None:
    items = synthetic(frames=80)
    a, b = (TrackingImage.of(k, 0.0, items[k].image, (240, 320), False).features()[1] for k in (0, 12))
    pairs = match_descriptors(a, b)
    assert len(pairs) > 100
    assert np.array_equal(pairs, _by_opencv(a, b))


@pytest.mark.parametrize("seed", range(6))
def test_equal_distances_go_to_the_first(seed: int) -> None:
    random = np.random.default_rng(seed)
    a = (random.random((97, 256)) < 0.06).astype(np.uint8)
    b = np.concatenate([a[random.permutation(97)[:60]], a[:9]])
    b = b ^ (random.random(b.shape) < 0.01).astype(np.uint8)
    a, b = np.packbits(a, axis=1), np.packbits(b, axis=1)
    pairs = match_descriptors(a, b)
    assert len(pairs) > 10
    assert np.array_equal(pairs, _by_opencv(a, b))


def test_one_descriptor_alone_matches_nothing() -> None:
    some = np.random.default_rng(0).integers(0, 256, (5, 32), dtype=np.uint8)
    for a, b in ((some, some[:1]), (some[:1], some), (some[:0], some), (some, some[:0])):
        assert match_descriptors(a, b).shape == (0, 2)
    assert len(match_descriptors(some, some[::-1])) == 5


def test_descriptors_of_another_length_are_refused() -> None:
    some = np.zeros((5, 61), np.uint8)
    with pytest.raises(ValueError, match=r"\(N, 32\)"):
        match_descriptors(some, some)
