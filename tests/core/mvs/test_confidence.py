"""What confidences are computed from."""

from __future__ import annotations

import numpy as np

from mvsgs_core.fusion import confidence as fused_confidence
from mvsgs_core.fusion.interface import Fused
from mvsgs_core.mvs.confidence import Evidence, probability_of_inlier

SIZE = (24, 32)
DOUBT = np.full(SIZE, 0.02, np.float32)


def evidence(gray: np.ndarray) -> Evidence:
    """Of a smooth surface that matches equally well everywhere; gray (H, W) as in views, with 128 taken out."""
    flat = np.full(SIZE, 0.5, np.float32)
    return Evidence.of(
        correlation=np.full((3, *SIZE), 0.8, np.float32), probability=flat, margin=flat, first_probability=flat,
        relative_pixel=0.04 * flat, gray=gray.astype(np.float32), inverse_depth=flat, gap=flat,
    )  # fmt: skip


def test_the_dark_is_less_sure_whatever_the_exposure() -> None:
    levels = np.full(SIZE, 120.0)
    levels[:, :6] = 12.0
    sure = probability_of_inlier(evidence(levels - 128.0))
    assert sure[12, 20] > sure[12, 2] + 0.1
    brighter = probability_of_inlier(evidence(1.6 * levels - 128.0))
    np.testing.assert_allclose(brighter[12], sure[12], atol=0.06)


def test_a_map_that_matched_badly_elsewhere_is_doubted_everywhere() -> None:
    flat = np.full(SIZE, 0.9, np.float32)
    fused = Fused(depth=2.0 * flat, support=2.0 * flat, violation=0.0 * flat, own=flat)
    agree = np.full(SIZE, 4, np.uint8)
    elsewhere = flat.copy()
    elsewhere[:, 16:] = 0.0  # far from what is looked at
    sure, doubted = (
        fused_confidence.probability_of_inlier(fused_confidence.features_of(fused, own, agree, agree, DOUBT))
        for own in (flat, elsewhere)
    )
    assert np.all(sure[:, :10] > doubted[:, :10] + 0.01)


def test_next_to_a_doubtful_pixel_all_are_doubted() -> None:
    flat = np.full(SIZE, 0.9, np.float32)
    agree = np.full(SIZE, 4, np.uint8)
    spot = flat.copy()
    spot[12, 16] = 0.0
    fused = Fused(depth=2.0 * flat, support=2.0 * flat, violation=0.0 * flat, own=flat)
    features = fused_confidence.features_of(fused, spot, agree, agree, DOUBT)
    lowest = features[-2]
    assert np.all(lowest[10:15, 14:19] == 0.0)
    assert lowest[9, 16] == flat[9, 16]


def test_agreement_says_less_where_parallax_is_small() -> None:
    flat, agree = np.full(SIZE, 0.9, np.float32), np.full(SIZE, 4, np.uint8)
    fused = Fused(depth=2.0 * flat, support=2.0 * flat, violation=0.0 * flat, own=flat)
    sure, unsure, blind = (
        fused_confidence.probability_of_inlier(
            fused_confidence.features_of(
                fused, flat, agree, agree, fused_confidence.uncertainty_of(np.full(SIZE, pixels, np.float32))
            )
        )
        for pixels in (100.0, 10.0, 0.0)
    )
    assert np.all(sure > unsure)
    assert np.all(unsure > blind)
    assert np.isfinite(blind).all()


def test_every_feature_has_a_weight() -> None:
    zero = np.zeros(SIZE, np.float32)
    fused = Fused(depth=zero + 1.0, support=zero, violation=zero, own=zero)
    count = np.zeros(SIZE, np.uint8)
    assert len(fused_confidence.features_of(fused, zero, count, count, DOUBT)) == len(fused_confidence.WEIGHTS)
    assert np.isfinite(probability_of_inlier(evidence(np.full(SIZE, -128.0)))).all()
