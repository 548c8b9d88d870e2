"""The synthetic town: its streets are free and lined, are driven one way, and a round ends where it began."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from mvsgs_core import camera
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.scene import drive, stage, town
from mvsgs_core.scene.lit import lit
from mvsgs_core.scene.path import look_at
from mvsgs_core.scene.renderer import SceneRenderer

INTRINSICS = np.array([40.0, 40.0, 31.5, 23.5])
SIZE = (48, 64)


@pytest.fixture(scope="module")
def block() -> SceneRenderer:
    """The streets around a single block."""
    return SceneRenderer(lit(town.build(0, streets=2), town.LIGHTING, threads=1))


def looking(plan: town.Plan, x: float, y: float, heading: float) -> np.ndarray:
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    eye = np.array([plan.x[0] + x, plan.y[0] + y, 1.9])
    return look_at(eye, eye + ahead)


def test_streets_are_free_and_lined_by_houses(block: SceneRenderer) -> None:
    plan = town.Plan.of(0, 2)
    length = float(plan.x[1] - plan.x[0])
    ahead = block.render(looking(plan, 0.0, 0.0, 0.0), INTRINSICS, SIZE, threads=1).depth
    assert ahead[23, 31:33].min() > length  # as far as the houses at the other end
    for heading in (0.5 * np.pi, -0.5 * np.pi):
        walls = []
        for x in np.linspace(12.0, length - 12.0, 6):
            view = block.render(looking(plan, x, 0.0, heading), INTRINSICS, SIZE, threads=1)
            walls.append(view.depth[14:20])  # above cars, below the eaves
            assert np.std(view.color[14:40]) > 0.02
        assert np.mean(np.abs(np.array(walls) - town.HALF_WIDTH) < 1.5) > 0.5


def test_depth_and_poses_are_the_scenes(block: SceneRenderer) -> None:
    plan = town.Plan.of(0, 2)
    pose = looking(plan, 20.0, 1.0, 0.3)
    depth = block.render(pose, INTRINSICS, SIZE, threads=1).depth
    points = camera.unproject(depth, INTRINSICS)[40] @ pose[:3, :3].T + pose[:3, 3]
    assert np.median(np.abs(points[:, 2])) < 1e-3  # the street is at height 0


def test_round_ends_where_it_began_and_is_driven_evenly() -> None:
    path = drive.TownPath(0, 900)
    np.testing.assert_allclose(path.pose(900), path.pose(0), atol=1e-9)
    places = np.array([path.pose(s)[:3, 3] for s in range(0, 901, 3)])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1) / 3
    assert abs(path.speed / path.SPEED - 1) < 0.3
    assert 0.5 * path.speed < steps.min() <= steps.max() < 1.4 * path.speed


def test_streets_are_driven_one_way_all_of_them_and_again() -> None:
    path = drive.TownPath(0)
    path.pose(36_000)  # 9 kilometers
    driven = Counter(zip(path.route.nodes[1:], path.route.nodes[2:]))
    assert not any((b, a) in driven for a, b in driven)
    assert len(driven) == 2 * town.STREETS * (town.STREETS - 1)
    path = drive.TownPath(0)
    path.pose(6_000)
    driven = Counter(zip(path.route.nodes[1:], path.route.nodes[2:]))
    assert max(driven.values()) > 1  # a loop within 1.5 kilometers


def test_is_a_data_set_like_the_other_scenes(block: SceneRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "renderer_of", lambda *_: block)
    items = list(Synthetic(scene="town", size=SIZE, frames=3, moving_object=1.0, threads=1))
    assert [item.image.shape for item in items] == [(*SIZE, 3)] * 3
    assert not np.array_equal(items[0].image, items[2].image)


def test_a_larger_town_has_more_streets_and_a_ring() -> None:
    path = drive.TownPath(0, streets=8)
    path.pose(60_000)
    driven = {frozenset(street) for street in zip(path.route.nodes, path.route.nodes[1:])}
    assert 2 * town.STREETS * (town.STREETS - 1) < len(driven) <= 2 * 8 * 7
    with pytest.raises(ValueError, match="even"):
        Synthetic(scene="town", streets=7)
