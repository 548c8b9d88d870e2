"""The map follows a loop closure: poses and scales that had drifted are corrected under a mapper that built on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.insertion import InsertionConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.owed import Owed
from tests.support.small_maps import RARE, mapped
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

pytestmark = pytest.mark.slow

DRIFT = 0.25  # share by which lengths have shrunk at the end
REFINEMENT = 240
DENSE = InsertionConfig(price=3e-4)  # so many splats that what is left of the drift is what limits the map
CONFIG = MapperConfig(iterations=12, refinement=0, threads=1, insertion=DENSE, density_control=RARE, device="cpu")


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
    assert result > 51.0


def test_a_correction_below_a_pixel_is_owed_nothing() -> None:
    mapper, owed = corrected(arc(), 0.01)
    assert owed == 0
    assert mapper.log.counts["corrected_keyframes"] > 0


def hopeless(views: list[RGBDKeyframe], config: MapperConfig = CONFIG) -> OnlineMapper:
    """A map whose keyframes have all moved, and whose losses never come back."""
    mapper = mapped(views, config)
    for view in mapper.views:
        view.loss_fast = 0.0
        view.begin_anew(moved=True)
    mapper.keyframes.owed.count(mapper.views)
    return mapper


def test_what_a_correction_owes_holds_the_next_keyframe_back_by_the_budget_of_one() -> None:
    views = arc()
    mapper = hopeless(views[:6])
    before = [view.visits for view in mapper.views]
    assert mapper.figures["iterations_pending"] == 6
    assert settled(mapper) == CONFIG.iterations
    assert [view.visits - visits for view, visits in zip(mapper.views, before)] == [CONFIG.iterations // 6] * 6
    assert mapper.figures["iterations_pending"] == 0
    for view in views[6:]:  # the rest is spread over what follows
        mapper.add_keyframe(view)
        assert settled(mapper) == 2 * CONFIG.iterations


def test_corrections_between_two_keyframes_owe_no_more_than_one() -> None:
    mapper = hopeless(arc()[:3])
    done = settled(mapper)
    for view in mapper.views:
        view.begin_anew(moved=True)
    mapper.keyframes.owed.count(mapper.views)
    assert done + settled(mapper) == CONFIG.iterations


def test_no_keyframe_is_owed_more_than_the_budget_of_one() -> None:
    mapper = hopeless(arc()[:1])
    assert settled(mapper) == CONFIG.iterations == mapper.views[0].visits_here
    mapper.add_keyframe(arc()[1])
    assert settled(mapper) == CONFIG.iterations


def test_at_the_streams_end_what_is_owed_takes_as_many_iterations_as_the_refinement() -> None:
    mapper = hopeless(arc()[:4])
    assert settled(mapper) == CONFIG.iterations
    mapper.config = replace(CONFIG, refinement=20)
    atlas = Atlas(mapper, {0: mapper})
    atlas.finish()
    assert settled(mapper) == 20 < 4 * CONFIG.iterations - CONFIG.iterations


def test_the_final_refinement_gives_half_of_its_iterations_to_what_is_still_owed() -> None:
    mapper = mapped(arc(), CONFIG)
    moved = mapper.views[3]
    moved.loss_fast = 0.0
    moved.begin_anew(moved=True)
    mapper.keyframes.owed.count(mapper.views)
    iterations = mapper.iterations
    for done in range(16):
        mapper.refine(done, 16)
    assert mapper.iterations - iterations == 16  # no more than without
    assert 8 <= moved.visits_here <= 8 + 2  # two more where the round over all eight keyframes comes to it


def test_the_next_keyframe_that_is_owed_is_found_without_a_look_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same as by a look at all of them, whatever happens to them meanwhile."""
    looks = 0
    plain = TrainingView.owed

    def counted(view: TrainingView, limit: int) -> bool:
        nonlocal looks
        looks += 1
        return plain(view, limit)

    one = mapped(arc()[:1], CONFIG).views[0]
    views = [replace(one, index=k, loss_before=0.0, visits_here=k % 5) for k in range(400)]
    owed, random, iterations = Owed(), np.random.default_rng(0), 0
    owed.count(views)
    monkeypatch.setattr(TrainingView, "owed", counted)
    while (found := owed.first(12)) is not None:
        if iterations % 50 == 0:
            expected = min((v for v in views if v.has_image and plain(v, 12)), key=lambda v: (v.visits_here, v.index))
            assert found is expected
        found.record(1.0)
        other = views[random.integers(len(views))]  # in its turn of the round over all
        other.record(float(random.choice([0.0, 1.0, 1.0])))
        if iterations == 100:
            views[7].drop_image()
        iterations += 1
    assert not any(v.has_image and plain(v, 12) for v in views)
    assert iterations > 1000
    assert looks < 4 * iterations


def test_what_is_owed_takes_the_half_on_all_of_what_is_pending() -> None:
    mapper = mapped(arc(), CONFIG)
    first = mapper.views[0]
    first.loss_before, first.visits_here = 0.0, 0
    mapper.keyframes.owed.count(mapper.views)
    mapper.schedule.add_budget(6)
    visits = first.visits
    for _ in range(6):
        mapper.step()
    assert mapper.schedule.pending == 0
    assert first.visits == visits + 3  # it is not in the window of the newest
