"""Where a map lies on the Earth: noise, false places, paths that do not tell, the file; and metres around a place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvsgs_core import geodesy, geometry
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.georeference import NoReferenceError, georeference, read_georeference, write_georeference

ORIGIN = np.array([47.37, 8.54, 410.0])
# metres a degree at the origin, by the ellipsoid's radii of curvature (not by the functions under test)
ECCENTRICITY = 0.0066943799901
ROOT = 1.0 - ECCENTRICITY * np.sin(np.radians(ORIGIN[0])) ** 2
NORTH = np.radians(1.0) * (6378137.0 * (1.0 - ECCENTRICITY) / ROOT**1.5 + ORIGIN[2])
EAST = np.radians(1.0) * (6378137.0 / ROOT**0.5 + ORIGIN[2]) * np.cos(np.radians(ORIGIN[0]))
SCALE, TURN = 4.0, geometry.so3_exp(np.array([1.9, 0.4, -0.7]))


def flight(count: int, extent: tuple[float, float, float], noise: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Poses in a frame and unit of their own, their places by GPS, and their positions in metres."""
    random = np.random.default_rng(seed)
    metres = random.uniform(-0.5, 0.5, (count, 3)) * extent
    seen = metres + noise * random.standard_normal((count, 3))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = TURN.T @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # upright: -y is up
    poses[:, :3, 3] = (metres @ TURN) / SCALE + [30.0, -2.0, 7.0]
    return poses, _places(seen), metres


def _places(metres: np.ndarray) -> np.ndarray:
    return np.asarray(ORIGIN + np.stack([metres[:, 1] / NORTH, metres[:, 0] / EAST, metres[:, 2]], axis=1))


def test_metres_around_a_place() -> None:
    near = np.array([[100.0, 0.0, 0.0], [0.0, -80.0, 0.0], [30.0, 40.0, 12.0]])
    np.testing.assert_allclose(geodesy.east_north_up(_places(near), ORIGIN), near, atol=0.003)  # the Earth is round
    # Zurich, by the published axes of the ellipsoid
    np.testing.assert_allclose(np.linalg.norm(geodesy.earth_centered(ORIGIN[None])), 6367007.0, atol=500.0)
    across = geodesy.middle(np.array([[0.0, 179.9, 0.0], [0.0, -179.9, 0.0], [0.0, -179.8, 0.0]]))
    np.testing.assert_allclose(across, [0.0, -179.9, 0.0])


def test_noise_and_false_places_leave_the_similarity_and_are_said() -> None:
    poses, places, metres = flight(40, (200.0, 150.0, 30.0), noise=5.0)
    false = np.arange(0, 40, 4)
    places[false] += np.random.default_rng(1).uniform(0.002, 0.02, (10, 3)) * [1.0, 1.0, 1e4]
    found = georeference(poses, places)
    assert found.outliers == len(false)
    assert found.positions == 40
    assert 5.0 < found.residual < 12.0  # the median distance of 5 m an axis is 7.7 m, a quarter is far off
    off = found.similarity.apply(poses[:, :3, 3]) - (metres - geodesy.east_north_up(found.origin[None], ORIGIN))
    turned = found.rotation @ TURN.T
    angle = np.degrees(np.linalg.norm(geometry.so3_log(turned[None])))
    assert abs(found.scale / SCALE - 1.0) < 3.0 * found.scale_deviation < 0.06
    assert angle < 3.0 * found.angle_deviation < 10.0
    assert np.linalg.norm(off.mean(axis=0)) < 3.0 * found.position_deviation * 3**0.5 < 6.0


@pytest.mark.parametrize("drift", [0.0, 0.7])
def test_deviations_are_what_noise_makes(drift: float) -> None:
    """Of 40 draws of the noise. drift: how alike the errors of successive places are."""
    scales, angles, said = [], [], []
    poses, _, metres = flight(60, (80.0, 60.0, 10.0), noise=0.0)
    order = np.argsort(metres[:, 0])  # a path
    poses, metres = poses[order], metres[order]
    for seed in range(40):
        noise = 2.0 * np.random.default_rng(seed).standard_normal((60, 3))
        for n in range(1, 60):
            noise[n] = drift * noise[n - 1] + (1.0 - drift**2) ** 0.5 * noise[n]
        places = _places(metres + noise)
        found = georeference(poses, places)
        scales.append(found.scale / SCALE - 1.0)
        angles.append(np.degrees(geometry.so3_log((found.rotation @ TURN.T)[None])[0]))
        said.append((found.scale_deviation, found.angle_deviation))
    scale, angle = np.median(said, axis=0)
    assert 0.7 < np.std(scales) / scale < 1.4
    assert 0.7 < np.sqrt(np.linalg.eigvalsh(np.cov(np.array(angles).T))[-1]) / angle < 1.4


@pytest.mark.parametrize(("count", "false"), [(4, 0), (5, 0), (6, 0), (7, 0), (10, 0), (6, 1), (7, 1), (10, 1)])
def test_few_places_are_as_sure_as_is_said(count: int, false: int) -> None:
    """Of 60 draws of path and noise; of more than five places a false one is left out."""
    off, outliers = [], []
    for seed in range(60):
        poses, places, _ = flight(count, (120.0, 100.0, 30.0), noise=1.0, seed=seed)
        places[:false, :2] += 0.001
        found = georeference(poses, places)
        off.append((found.scale / SCALE - 1.0) / found.scale_deviation)
        outliers.append(found.outliers)
    assert np.mean(np.array(outliers) == false) > 0.95
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.6
    assert np.mean(np.abs(off) < 2.0) > 0.8


def test_paths_that_do_not_tell() -> None:
    poses, places, _ = flight(30, (4.0, 3.0, 1.0), noise=5.0)
    with pytest.raises(NoReferenceError, match=r"the path, .* m, is too short for GPS that is off by"):
        georeference(poses, places)
    with pytest.raises(NoReferenceError, match="3 camera positions have a GPS place, 4 are needed"):
        georeference(poses[:3], places[:3])
    with pytest.raises(NoReferenceError, match="all camera positions coincide"):
        georeference(np.tile(poses[:1], (9, 1, 1)), places[:9])
    with pytest.raises(NoReferenceError, match="all 30 GPS places are the same"):
        georeference(poses, np.tile(places[:1], (30, 1)))
    frozen = flight(30, (200.0, 150.0, 30.0), noise=1.0)[1]
    frozen[:20] = frozen[0]
    with pytest.raises(NoReferenceError):
        georeference(poses, frozen)


def test_on_a_line_the_roll_is_the_cameras_only_if_said() -> None:
    poses, places, _ = flight(40, (300.0, 0.0, 0.0), noise=1.0)
    with pytest.raises(NoReferenceError, match=r"nearly on a line, .* evaluator.camera_up=true"):
        georeference(poses, places)
    found = georeference(poses, places, camera_up=True)
    assert found.camera_up
    assert np.degrees(np.linalg.norm(geometry.so3_log((found.rotation @ TURN.T)[None]))) < 1.0
    off = found.similarity.apply(poses[:, :3, 3]) - geodesy.east_north_up(places, found.origin)
    assert np.median(np.linalg.norm(off, axis=1)) < 3
    upward, high, _ = flight(40, (0.0, 0.0, 300.0), noise=1.0)
    with pytest.raises(NoReferenceError, match="too steep"):
        georeference(upward, high, camera_up=True)


def test_the_file_comes_back_and_damage_is_named(tmp_path: Path) -> None:
    poses, places, _ = flight(12, (50.0, 50.0, 20.0), noise=1.0)
    found = georeference(poses, places)
    path = tmp_path / "georeference.json"
    write_georeference(path, found)
    again = read_georeference(path)
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    text = path.read_text()
    for damaged in (text[:100], text.replace('"scale": ', '"scale": -'), text.replace('"latitude"', '"lat"'), "[]"):
        path.write_text(damaged)
        with pytest.raises(BadFileError, match=r"georeference.json is no georeference.json"):
            read_georeference(path)
