"""Similarities between two frames, solved for from positions, and lengths in another unit."""

from __future__ import annotations

import numpy as np
import pytest

from mvsgs_core import geometry

TRUE = geometry.Similarity(2.5, geometry.so3_exp(np.array([0.3, -0.7, 1.1])), np.array([4.0, -2.0, 9.0]))


def positions(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, 3.0, (*shape, 3))


def test_positions_tell_the_similarity_between_them() -> None:
    here = positions(20)
    found = geometry.umeyama(here, TRUE.apply(here))
    assert found.scale == pytest.approx(TRUE.scale)
    np.testing.assert_allclose(found.rotation, TRUE.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, TRUE.translation, atol=1e-12)
    np.testing.assert_allclose(TRUE.apply(np.eye(3))[1], 2.5 * TRUE.rotation[:, 1] + TRUE.translation)


def test_many_sets_at_once_are_as_each_by_itself() -> None:
    here = positions(7, 5)
    there = positions(8, 5)[1:]  # no similarity: least squares, some with a mirror image nearer
    scale, rotation, translation = geometry.umeyama_of_each(here, there)
    for n in range(7):
        one = geometry.umeyama(here[n], there[n])
        assert np.linalg.det(rotation[n]) == pytest.approx(1.0)
        np.testing.assert_allclose(scale[n], one.scale, rtol=1e-12)
        np.testing.assert_allclose(rotation[n], one.rotation, atol=1e-12)
        np.testing.assert_allclose(translation[n], one.translation, atol=1e-12)


def test_what_is_seen_from_a_pose_moves_with_it() -> None:
    old, new = geometry.se3_exp(np.array([[0.3, -0.1, 0.2, 0.1, 0.4, -0.2], [-0.5, 0.4, 0.1, -0.6, 0.2, 0.9]]))
    moved = geometry.Similarity.between(old, new, 1.7)
    seen = positions(4)
    world = seen @ old[:3, :3].T + old[:3, 3]
    np.testing.assert_allclose(moved.apply(world), 1.7 * seen @ new[:3, :3].T + new[:3, 3], atol=1e-12)
    np.testing.assert_allclose(moved.shifts(world), np.linalg.norm(moved.apply(world) - world, axis=1))


def test_lengths_in_another_unit_leave_turns_and_what_was_given() -> None:
    poses, twists = geometry.se3_exp(np.ones((2, 6))), np.ones((2, 6))
    assert (geometry.scaled(poses, 3.0)[:, :3, 3] == 3.0 * poses[:, :3, 3]).all()
    assert (geometry.scaled(poses, 3.0)[:, :3, :3] == poses[:, :3, :3]).all()
    assert geometry.twist_scaled(twists, 3.0).tolist() == [[3.0] * 3 + [1.0] * 3] * 2
    assert (poses == geometry.se3_exp(np.ones((2, 6)))).all()
    assert (twists == 1.0).all()
