"""A ray meets the map where a camera sees it; a ruler and a box say what they should."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core.export.picking import Box, Ruler, hit, kept
from tests.support.tiny_map import INTRINSICS, SIZE, final_map

ALL = np.tile([0.0, 100.0], (3, 1))


def test_a_ray_meets_the_map_where_a_camera_sees_it() -> None:
    final = final_map()
    render = final.render(np.eye(4) + np.pad(final.origin[:, None], ((0, 1), (3, 0))), INTRINSICS, SIZE)
    fx, fy, cx, cy = INTRINSICS
    for row, column in ((12, 16), (6, 20), (18, 9)):
        ray = np.array([(column - cx) / fx, (row - cy) / fy, 1.0])
        found = hit(final, np.zeros(3), 7.0 * ray)  # of any length
        assert found is not None
        np.testing.assert_allclose(found, ray * float(render.depth[row, column]), rtol=0.02)


def test_a_ray_that_meets_nothing() -> None:
    assert hit(final_map(), np.zeros(3), np.array([0.0, 0.0, -1.0])) is None
    assert hit(final_map(), np.zeros(3), np.zeros(3)) is None


def test_a_ruler_measures_and_learns_its_unit() -> None:
    ruler = Ruler()
    with pytest.raises(ValueError, match="measure a distance first"):
        ruler.calibrate(2.0)
    ruler.add(np.zeros(3))
    assert ruler.distance is None
    ruler.add(np.array([3.0, 0.0, 4.0]))
    assert ruler.distance == 5.0
    ruler.calibrate(2.0)
    assert ruler.distance == pytest.approx(2.0)
    with pytest.raises(ValueError, match="no length"):
        ruler.calibrate(0.0)
    ruler.add(np.zeros(3))  # a third place
    ruler.add(np.array([0.0, 10.0, 0.0]))
    assert ruler.distance == pytest.approx(4.0)


def test_a_box_bounds_along_its_axes_and_its_ends_bound_nothing() -> None:
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    box = Box.around(points, turn)
    far = np.array([[0.0, 50.0, 0.0]])
    assert box.inside(np.concatenate([points, far]), ALL).all()
    half = ALL.copy()
    half[0] = 0.0, 50.0  # the first axis is y
    chosen = box.inside(points, half)
    assert (points[chosen, 1] < 0.05).all()
    assert (points[~chosen, 1] > -0.05).all()
    assert not box.inside(far, half).any()


def test_what_is_kept_is_the_chosen_splats() -> None:
    final = final_map()
    chosen = final.splats.means.numpy()[:, 0] > 0
    left = kept(final, chosen)
    assert 0 < len(left.splats) == chosen.sum() < len(final.splats)
    assert len(left.anchors) == len(left.splats)
    assert (left.splats.means[:, 0] > 0).all()
