"""The radial distortion of a lens whose focal length is not known: found where it is, and not where there is noise."""

from __future__ import annotations

import numpy as np
import pytest

from bench import lenses
from mvsgs_core import geometry
from mvsgs_core.tracking.estimation.bundle_adjustment import Graph, reproject
from mvsgs_core.tracking.estimation.radial import COMMON, estimate_radial

INTRINSICS = np.array([256.0, 256.0, 159.5, 119.5])
KEYFRAMES, POINTS, NOISE = 6, 500, 0.3  # pixels


def matches(k1: float, noise: float = NOISE) -> Graph:
    """Cameras that move and turn, each matched with each, through a lens: what a pinhole adjustment starts from."""
    random = np.random.default_rng(1)
    turns = 0.25 * np.stack([np.sin(np.arange(KEYFRAMES)), np.cos(np.arange(KEYFRAMES)), np.arange(KEYFRAMES) / 6], 1)
    poses = geometry.se3_exp(np.concatenate([random.normal(0.0, 0.2, (KEYFRAMES, 3)), turns], axis=1))
    poses = poses @ geometry.inverse(poses[0])
    straight = random.uniform([0, 0], [319, 239], (KEYFRAMES, POINTS, 2)).transpose(0, 2, 1)
    near = random.uniform(0.4, 1.5, (KEYFRAMES, POINTS))
    source, to = (
        np.array(ends) for ends in zip(*((a, b) for a in range(KEYFRAMES) for b in range(KEYFRAMES) if a != b))
    )
    seen, z = reproject(poses, near, straight, INTRINSICS, source, to)
    inside = (z > 0.1) & np.all((seen >= 0) & (seen <= np.array([319, 239])[:, None]), axis=1)
    target = bent(seen, k1) + random.normal(0.0, noise, seen.shape)
    return Graph(
        poses, near, bent(straight, k1), INTRINSICS, source, to, np.where(inside[:, None], target, 0.0),
        inside[:, None] * np.array([1.0, 0.0, 1.0])[:, None], np.arange(KEYFRAMES) > 0, np.ones(KEYFRAMES, bool),
    )  # fmt: skip


def bent(pixels: np.ndarray, k1: float) -> np.ndarray:
    """Where the lens shows what a pinhole shows at pixels (N, 2, M)."""
    rays = (pixels - INTRINSICS[2:, None]) / INTRINSICS[:2, None]
    seen = rays * (1.0 + k1 * np.sum(rays**2, axis=1, keepdims=True))
    return np.asarray(seen * INTRINSICS[:2, None] + INTRINSICS[2:, None])


@pytest.mark.parametrize("k1", [-0.12, 0.0, 0.06])
def test_it_is_found_beside_the_focal_length(k1: float) -> None:
    found = estimate_radial(matches(k1), threads=1)
    assert abs(found.k1 - k1) < 2.0 * found.k1_sigma
    assert found.k1_sigma < 0.5 * COMMON, "these matches tell it"
    assert found.clear == (k1 != 0.0)
    assert abs(np.log(found.focal_factor)) < 2.0 * found.slope * found.k1_sigma


def test_noise_alone_bends_no_lens() -> None:
    """Errors measured in pixels of the straightened image would shrink with it: k1 of 0.02 and more."""
    assert abs(estimate_radial(matches(0.0, noise=0.5), threads=1).k1) < 0.004


def test_without_matches_it_is_what_lenses_are_like() -> None:
    nothing = matches(0.0)
    nothing.information = 0.0 * nothing.information
    found = estimate_radial(nothing, threads=1)
    assert (found.k1, found.k1_sigma, found.focal_factor) == (0.0, COMMON, 1.0)
    assert found.error > COMMON


def test_what_lenses_are_like_is_that_of_published_ones() -> None:
    bends = [abs(lens.one()[0]) for lens in lenses.PUBLISHED]
    assert pytest.approx(lenses.NORMAL * float(np.median(bends)), abs=0.001) == COMMON
