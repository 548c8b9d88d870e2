"""The frame in which poses were given: found from positions and orientations, written, read, and refused where none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core import geometry
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.geometry import Similarity
from mvsgs_core.given_frame import GivenFrame, NoFrameError, given_frame, read_given_frame, write_given_frame

TRUE = Similarity(2.5, geometry.so3_exp(np.array([0.3, -1.2, 2.0])), np.array([1e5, -30.0, 5.0]))
BODY_FROM_CAMERA = geometry.rigid(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def walk(count: int = 60, bend: float = 1.0) -> np.ndarray:
    """(N, 4, 4) of a camera that turns; bend: 0 along a line."""
    poses = []
    for t in np.linspace(0.0, 1.0, count):
        turn = geometry.so3_exp(np.array([0.1 * np.sin(5.0 * t), 0.5 * t, 0.1]))
        poses.append(geometry.rigid(turn, np.array([4.0 * t, bend * np.sin(6.0 * t), 0.3 * bend * np.cos(4.0 * t)])))
    return np.array(poses)


def noisy(poses: np.ndarray) -> np.ndarray:
    """2 cm and .6 degrees about each axis."""
    random, found = np.random.default_rng(0), poses.copy()
    found[:, :3, 3] += 0.02 * random.normal(size=(len(poses), 3))
    found[:, :3, :3] = found[:, :3, :3] @ geometry.so3_exp(0.01 * random.normal(size=(len(poses), 3)))
    return found


@pytest.mark.parametrize("bend", [1.0, 0.0])
def test_a_frame_is_found_from_positions_and_orientations_on_a_line_too(bend: float) -> None:
    poses = walk(bend=bend)
    found = given_frame(poses, noisy(TRUE.poses(poses))).similarity
    assert abs(found.scale / TRUE.scale - 1.0) < 2e-3
    assert np.degrees(np.linalg.norm(geometry.so3_log(found.rotation @ TRUE.rotation.T))) < 0.2
    np.testing.assert_allclose(found.apply(poses[:, :3, 3]), TRUE.apply(poses[:, :3, 3]), atol=0.02)


def test_an_exact_frame_is_found_exactly() -> None:
    poses = walk(bend=0.0)
    found = given_frame(poses, TRUE.poses(poses))
    np.testing.assert_allclose(found.similarity.apply(poses[:, :3, 3]), TRUE.apply(poses[:, :3, 3]), atol=1e-8)
    assert (found.poses, found.distance < 1e-9, found.angle < 1e-6) == (60, True, True)


def test_what_tells_no_frame_is_refused_and_says_why() -> None:
    poses = walk()
    given = TRUE.poses(poses)
    with pytest.raises(NoFrameError, match="2 frames of the map came with a pose, 3 are needed"):
        given_frame(poses[:2], given[:2])
    with pytest.raises(NoFrameError, match="coincide"):
        given_frame(poses, np.repeat(given[:1], len(poses), axis=0))
    with pytest.raises(NoFrameError, match=r"turn otherwise than the camera.*not of what carries it"):
        given_frame(poses, given @ np.linalg.inv(BODY_FROM_CAMERA))
    for size in (1e120, 1e300):
        far = given.copy()
        far[:, :3, 3] *= size
        with pytest.raises(NoFrameError, match="no positions"):
            given_frame(poses, far)
    elsewhere = given.copy()
    elsewhere[:, :3, 3] = 100.0 * np.random.default_rng(0).normal(size=(len(poses), 3))
    with pytest.raises(NoFrameError):
        given_frame(poses, elsewhere)


def test_a_frame_comes_back_from_its_file_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "given_frame.json"
    write_given_frame(file, GivenFrame(TRUE, 60, 0.03, 0.5))
    found = read_given_frame(file)
    assert (found.similarity.scale, found.poses, found.distance, found.angle) == (2.5, 60, 0.03, 0.5)
    assert np.array_equal(found.similarity.rotation, TRUE.rotation)
    assert np.array_equal(found.similarity.translation, TRUE.translation)
    whole = json.loads(file.read_text())
    for name, wrong in (
        ("scale", -1.0),
        ("rotation", np.zeros((3, 3)).tolist()),
        ("translation", [0.0]),
        ("version", 2),
    ):
        file.write_text(json.dumps(whole | {name: wrong}))
        with pytest.raises(BadFileError, match=r"is no given_frame\.json of this program"):
            read_given_frame(file)
