"""The map follows a loop closure: poses and scales that had drifted are corrected under a mapper that built on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.small_maps import mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

pytestmark = pytest.mark.slow

DRIFT = 0.25  # share by which lengths have shrunk at the end
REFINEMENT = 60
DENSE = InsertionConfig(price=3e-4)  # so many splats that what is left of the drift is what limits the map
CONFIG = MapperConfig(iterations=12, refinement=0, threads=1, insertion=DENSE)


def arc() -> list[RGBDKeyframe]:
    return [rgbd_keyframe(k, pose_on_arc(k / 7)) for k in range(8)]


def drifted(views: list[RGBDKeyframe], drift: float = DRIFT) -> tuple[list[RGBDKeyframe], np.ndarray]:
    """Every step and depth shrinks a little more: as a tracker without loops sees it; and the factors (K,)."""
    factors = np.exp(-drift * np.arange(len(views)) / len(views))
    found = [views[0]]
    for before, view, factor in zip(views, views[1:], factors[1:]):
        step = np.linalg.inv(before.world_from_cam) @ view.world_from_cam
        step[:3, 3] *= factor
        depth = (view.depth * factor).astype(np.float32)
        found.append(replace(view, world_from_cam=found[-1].world_from_cam @ step, depth=depth))
    return found, factors


def corrected(views: list[RGBDKeyframe], drift: float) -> tuple[OnlineMapper, int]:
    """A map of drifted keyframes, their poses corrected; and the iterations that are owed to them for it."""
    wrong, factors = drifted(views, drift)
    mapper = mapped(wrong, CONFIG)
    assert mapper.correct(np.arange(8), np.stack([view.world_from_cam for view in views]), 1.0 / factors) > 0
    for view, truth, factor in zip(mapper.views, views, factors):
        np.testing.assert_allclose(view.world_from_cam, truth.world_from_cam)
        assert view.scale == 1.0 / factor
    return mapper, settled(mapper)


def settled(mapper: OnlineMapper) -> int:
    """Does what is pending and owed; returns the iterations."""
    before = mapper.iterations
    while mapper.step():
        pass
    return mapper.iterations - before


def refined(mapper: OnlineMapper) -> float:
    """PSNR over all keyframes after a refinement."""
    for done in range(REFINEMENT):
        mapper.refine(done, REFINEMENT)
    return psnr(mapper)


def psnr(mapper: OnlineMapper) -> float:
    errors = [float((mapper.render(v).color - v.target).square().mean()) for v in mapper.views]
    return float(-10.0 * np.log10(np.mean(errors)))


@pytest.mark.parametrize("drift", [DRIFT, DRIFT / 3])
def test_a_map_that_is_corrected_renders_as_well_as_one_that_never_drifted(drift: float) -> None:
    views = arc()
    follows, owed = corrected(views, drift)
    stays, knows = (mapped(given, CONFIG) for given in (drifted(views, drift)[0], views))
    assert 0 < owed < 24  # a quarter of what the map was trained: it keeps most of that
    result = refined(follows)
    assert result > refined(stays) + 0.3
    assert result > refined(knows) - 0.3
    assert result > 47.0


def test_a_correction_below_a_pixel_is_owed_nothing() -> None:
    mapper, owed = corrected(arc(), 0.01)
    assert owed == 0
    assert mapper.log.counts["corrected_keyframes"] > 0


def test_a_keyframe_whose_loss_does_not_come_back_is_owed_the_budget_of_one() -> None:
    mapper = mapped(arc()[:3], CONFIG)
    for view in mapper.views:
        view.loss_fast = 0.0
        view.begin_anew(moved=True)
    visits = [view.visits for view in mapper.views]
    assert mapper.figures["iterations_pending"] == 3
    assert settled(mapper) == 3 * CONFIG.iterations
    assert [view.visits - before for view, before in zip(mapper.views, visits)] == [CONFIG.iterations] * 3
    assert mapper.figures["iterations_pending"] == 0


def test_what_is_owed_takes_the_half_on_all_of_what_is_pending() -> None:
    mapper = mapped(arc(), CONFIG)
    first = mapper.views[0]
    first.loss_before, first.visits_here = 0.0, 0
    mapper.schedule.add_budget(6)
    visits = first.visits
    for _ in range(6):
        mapper.step()
    assert mapper.schedule.pending == 0
    assert first.visits == visits + 3  # it is not in the window of the newest
