"""Whole reconstructions of points that are known: any order, wrong matches, planes, an unknown lens, two parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.photographs.ordering import chain, covisibility
from mvsgs_core.photographs.reconstruction import Reconstruction, all_models, connected
from mvsgs_core.photographs.registration import MIN_SEEN, register
from mvsgs_core.photographs.sparse_map import Model
from mvsgs_core.photographs.tracks import link
from mvsgs_core.photographs.two_views import TwoViews
from tests.support.photograph_ring import SIZE, Ring, position_error, ring


def models_of(of: Ring, pairs: dict[tuple[int, int], TwoViews], factor: float = 1.0, free: bool = True) -> list[Model]:
    tracks = link(of.features, {pair: views.matches for pair, views in pairs.items()})
    count = len(of.pixels)
    lens = replace(of.lens, factor=factor, k1=0.0, k2=0.0)
    everything = np.ones(count, bool)
    return list(all_models(pairs, of.features, tracks, lens, np.tile(SIZE, (count, 1)), everything, free))


def in_order(of: Ring, order: np.ndarray) -> Ring:
    return replace(of, cam_from_world=of.cam_from_world[order], pixels=of.pixels[order])


@pytest.mark.parametrize("order", [np.arange(8), np.random.default_rng(0).permutation(8)], ids=["sorted", "shuffled"])
def test_photographs_in_any_order_with_wrong_matches(order: np.ndarray) -> None:
    of = in_order(ring(8, k1=-0.05, k2=0.02), order)
    (model,) = models_of(of, of.pairs(wrong=0.2), factor=1.15)
    assert model.registered.all()
    assert sorted(model.order) == list(range(8))
    assert position_error(model.cam_from_world, of.cam_from_world) < 0.002
    assert abs(model.lens.factor - 1.0) < 0.02
    assert abs(model.lens.k1 + 0.05) < 0.03
    assert np.median(model.residual) < 0.6


def test_a_plane_is_no_obstacle() -> None:
    """Also where two views of it leave two poses."""
    of = ring(6, flat=True)
    (model,) = models_of(of, of.pairs(), free=False)
    assert model.registered.all()
    assert position_error(model.cam_from_world, of.cam_from_world) < 0.01


@pytest.mark.parametrize("times", [3, 4])
def test_copies_of_photographs_are_no_obstacle(times: int) -> None:
    """They match each other better than any two photographs match, and no map begins with two of them."""
    once = ring(5, flat=True)
    once.pixels[np.random.default_rng(1).random(once.pixels.shape[:2]) < 0.3] = np.nan  # no feature is there
    pixels = np.repeat(once.pixels, times, axis=0)
    pixels += np.random.default_rng(0).normal(0.0, 0.05, pixels.shape)  # as edited and compressed again
    lens = replace(once.lens, intrinsics=np.repeat(once.lens.intrinsics, times, axis=0))
    of = Ring(np.repeat(once.cam_from_world, times, axis=0), once.world, pixels, lens)
    (model,) = models_of(of, of.pairs(), free=False)
    assert model.registered.all()
    assert position_error(model.cam_from_world, of.cam_from_world) < 0.01


def test_a_lens_that_is_known_stays() -> None:
    of = ring(5)
    (model,) = models_of(of, of.pairs(), free=False)
    np.testing.assert_equal(vars(model.lens), vars(of.lens))


def beside(*rings: Ring) -> Ring:
    """Photographs of several places that share nothing; features of one are none of another."""
    points = [of.pixels.shape[1] for of in rings]
    first = np.cumsum([0, *points])
    pixels = [np.full((len(of.pixels), first[-1], 2), np.nan) for of in rings]
    for n, of in enumerate(rings):
        pixels[n][:, first[n] : first[n + 1]] = of.pixels
    return Ring(
        np.concatenate([of.cam_from_world for of in rings]),
        np.concatenate([of.world for of in rings]),
        np.concatenate(pixels),
        replace(rings[0].lens, intrinsics=np.concatenate([of.lens.intrinsics for of in rings])),
    )


def test_photographs_that_share_nothing_are_two_parts() -> None:
    both = beside(ring(4), ring(4, seed=5))
    models = models_of(both, both.pairs())
    assert sorted(tuple(np.flatnonzero(model.registered)) for model in models) == [(0, 1, 2, 3), (4, 5, 6, 7)]


def test_places_that_were_photographed_twice_do_not_keep_a_map_from_growing() -> None:
    twice = [ring(2, step=24.0, seed=seed) for seed in (1, 2, 3)]  # these match best
    of = beside(*twice, ring(5, points=120))
    models = models_of(of, of.pairs())
    assert [np.flatnonzero(model.registered).tolist() for model in models] == [[6, 7, 8, 9, 10]]


def test_groups_are_what_pairs_tie_together() -> None:
    among = np.ones(9, bool)
    among[8] = False
    groups = connected([(0, 1), (3, 4), (4, 5), (6, 2), (1, 2), (5, 8), (7, 8)], among)
    assert [np.flatnonzero(group).tolist() for group in groups] == [[0, 1, 2, 6], [3, 4, 5]]


def test_a_photograph_of_something_else_gets_no_pose() -> None:
    of = ring(6)
    pixels = of.pixels.copy()
    pixels[3] = np.random.default_rng(1).permutation(pixels[3])
    strange = replace(of, pixels=pixels)
    (model,) = models_of(strange, strange.pairs())
    assert np.flatnonzero(~model.registered).tolist() == [3]


def test_a_photograph_that_the_map_fits_roughly_comes_last() -> None:
    """As where the map is bent, far from where it began."""
    of = ring(6)
    pixels = of.pixels.copy()
    pixels[3] += np.random.default_rng(1).normal(0.0, 8.0, pixels[3].shape)
    rough = replace(of, pixels=pixels)
    (model,) = models_of(rough, rough.pairs())
    assert model.order[-1] == 3
    assert position_error(model.cam_from_world, of.cam_from_world) < 0.05


def test_a_small_part_has_the_lens_of_the_large_one() -> None:
    both = beside(ring(10, k1=-0.05), ring(3, k1=-0.05, seed=5))
    first, second = models_of(both, both.pairs(), factor=1.15)
    assert [int(model.registered.sum()) for model in (first, second)] == [10, 3]
    np.testing.assert_equal(vars(second.lens), vars(first.lens))


def test_a_part_by_another_camera_has_a_lens_of_its_own() -> None:
    one, other = ring(12, k1=-0.05), ring(10, k1=0.08, seed=5)
    other = replace(other, lens=replace(other.lens, intrinsics=1.4 * other.lens.intrinsics))
    pixels = (other.pixels - [0.5 * (SIZE[1] - 1), 0.5 * (SIZE[0] - 1)]) * 1.4 + 1.4 * np.array([319.5, 239.5])
    both = beside(one, replace(other, pixels=pixels))
    first, second = models_of(both, both.pairs())
    assert second.registered.sum() == 10
    assert abs(first.lens.k1 + 0.05) < 0.03
    assert abs(second.lens.k1 - 0.08) < 0.03
    assert position_error(second.cam_from_world[12:], other.cam_from_world) < 0.005


def test_a_photograph_that_comes_and_goes_does_not_keep_the_map_from_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that PnP takes and adjustment drops, beside one that never gets a pose: both are tried again."""
    of, random = ring(8), np.random.default_rng(0)
    pixels = of.pixels.copy()
    few = np.flatnonzero(np.isfinite(pixels[3, :, 0]))
    pixels[3, few[60:]] = np.nan
    pixels[3] += random.normal(0.0, 8.0, pixels[3].shape)
    strange = np.flatnonzero(np.isfinite(pixels[6, :, 0]))
    pixels[6, strange[40:]] = np.nan
    pixels[6, strange[:40]] = random.uniform(0, 480, (40, 2))
    odd = replace(of, pixels=pixels)
    pairs = odd.pairs()
    for a, b in ((2, 3), (3, 4), (5, 6), (6, 7)):
        both = np.flatnonzero(np.isfinite(pixels[a, :, 0]) & np.isfinite(pixels[b, :, 0]))
        pairs[a, b] = replace(next(iter(pairs.values())), matches=np.stack([both, both], axis=1))
    adjusted, adjust = [0], Reconstruction._adjust_all

    def counted(self: Reconstruction, last: bool = False) -> None:
        adjusted[0] += 1
        assert adjusted[0] < 100, "it goes on for ever"
        adjust(self, last)

    monkeypatch.setattr(Reconstruction, "_adjust_all", counted)
    (model,) = models_of(odd, pairs)
    assert {0, 1, 2, 4, 5, 7} <= set(np.flatnonzero(model.registered).tolist())
    assert not model.registered[6]


def test_two_photographs_alone_are_no_model() -> None:
    of = ring(2)
    assert models_of(of, of.pairs()) == []
    assert models_of(ring(4), {}) == []


def test_a_photograph_finds_its_pose_among_wrong_points() -> None:
    of = ring(3, k1=-0.05)
    seen = np.flatnonzero(np.isfinite(of.pixels[1, :, 0]))
    pixels = of.pixels[1, seen].copy()
    pixels[::3] = np.random.default_rng(0).uniform(0, 480, pixels[::3].shape)
    pose = register(1, of.world[seen], pixels, of.lens)
    assert pose is not None
    np.testing.assert_allclose(pose, of.cam_from_world[1], atol=0.01)
    assert register(1, of.world[seen[: MIN_SEEN - 1]], pixels[: MIN_SEEN - 1], of.lens) is None
    nonsense = np.random.default_rng(1).uniform(0, 480, pixels.shape)
    assert register(1, of.world[seen], nonsense, of.lens) is None


def test_neighbors_leave_after_each_other() -> None:
    order = np.random.default_rng(3).permutation(9)
    place = np.random.default_rng(0).uniform(0, 1, 900)  # each point is seen by photographs near its place alone
    sees = np.abs(np.arange(9)[:, None] / 8 - place) < 0.15
    photograph, point = np.nonzero(sees[order])
    shared = covisibility(photograph, point, 9)
    assert shared[0, 1] == np.sum(sees[order[0]] & sees[order[1]])
    assert np.all(np.diag(shared) == 0)
    left = [int(order[n]) for n in chain(shared, list(range(9)))]
    assert left in (list(range(9)), list(range(9))[::-1])
    assert chain(shared, []) == []
