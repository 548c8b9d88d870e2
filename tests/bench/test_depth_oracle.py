"""The oracle of depth: nearly 1 where poses, images and depths are exact; low where poses are off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.depth.data import Scene, load_scene
from bench.depth.oracle import oracle, oracle_rows, within
from mvsgs_core import geometry

AREA = 320 * 240


@pytest.fixture(scope="module")
def room() -> Scene:
    return load_scene("room", AREA, count=4)


@pytest.mark.slow
def test_the_synthetic_room_allows_perfect_depth(room: Scene) -> None:
    found = oracle(room, AREA)
    assert within(found.carried, align=False) > 0.98
    assert within(found.triangulated, align=False) > 0.98
    assert np.median(found.off) < 0.3
    assert np.median(found.across) < 0.15
    assert np.all(found.across <= found.off + 1e-9)


@pytest.mark.slow
def test_poses_that_do_not_fit_the_images_lower_it(room: Scene) -> None:
    """A turn of half a degree hardly moves surfaces, but matches lie 2 to 3 pixels off."""
    turn = geometry.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.5), 0.0]))
    views = [replace(v, world_from_cam=v.world_from_cam @ turn) if n % 2 else v for n, v in enumerate(room.views)]
    found = oracle(replace(room, views=views), AREA)
    assert within(found.carried, align=False) > 0.9
    assert within(found.triangulated, align=False) < 0.9
    assert np.median(found.off) > 1.0


@pytest.mark.slow
def test_alignment_divides_out_a_maps_scale_only(room: Scene) -> None:
    ratios = [np.array([2.0, 2.0, 2.0, 3.0]), np.zeros(0)]
    assert within(ratios, align=False) == 0.0
    assert within(ratios, align=True) == 0.75
    names = [row.name for row in oracle_rows(room, AREA, tracked=True)]
    assert len(names) == 4
    assert len(oracle_rows(room, AREA, tracked=False)) == 6


def test_without_true_depth_it_says_so(room: Scene) -> None:
    with pytest.raises(ValueError, match="no keyframe with true depth"):
        oracle(replace(room, truths=[None] * len(room.truths)), AREA)
