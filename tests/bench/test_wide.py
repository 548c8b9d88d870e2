"""Scenes of bench.wide that are measured at several times; what two results of COLMAP differ by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.baselines.colmap_poses import Model
from bench.pieces import in_pieces
from bench.table import Row, failed
from bench.wide import Solved, apart, beside


def test_what_was_measured_is_kept_and_what_is_missing_named(tmp_path: Path) -> None:
    asked: list[str] = []

    def measured(name: str) -> list[Row]:
        asked.append(name)
        return [Row(f"{name}: parts", len(asked))]

    def made(names: list[str], resume: bool = True, minutes: float | None = None, size: int = 1) -> list[Row]:
        return in_pieces(names, tmp_path, resume, minutes, measured, {"size": size})

    assert [row.value for row in made(["a", "b"], minutes=-1.0)] == ["a, b"]
    assert made(["a"]) == [Row("a: parts", 1)]
    assert made(["a", "b"]) == [Row("a: parts", 1), Row("b: parts", 2)]
    assert made(["a", "b"], minutes=-1.0) == [Row("a: parts", 1), Row("b: parts", 2)]
    assert made(["a"], resume=False) == [Row("a: parts", 3)]
    assert made(["a"], size=2) == [Row("a: parts", 4)]  # what was measured otherwise is no result of this call
    assert made(["a"], size=2) == [Row("a: parts", 4)]
    assert asked == ["a", "b", "a", "a"]


def test_what_failed_is_measured_again(tmp_path: Path) -> None:
    outcomes = [[failed("a: ours", "no memory")], [Row("a: parts", 1)]]

    def made() -> list[Row]:
        return in_pieces(["a"], tmp_path, True, None, lambda name: outcomes.pop(0), None)

    assert made() == [failed("a: ours", "no memory")]
    assert made() == made() == [Row("a: parts", 1)]


def test_results_of_two_orders_are_compared_photograph_by_photograph() -> None:
    """In frames and units of their own, where either lacks some."""
    random = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, 3] = random.normal(size=(8, 3))
    none = np.zeros((0, 3))
    first = Model(np.arange(7), poses[:7], none, none, {}, 1.0, 500.0)
    order = random.permutation(np.arange(1, 8))
    other = poses[order]
    other[:, :3, 3] = 3.0 * other[:, :3, 3] + [1.0, 2.0, 3.0]
    same, focal = apart("a", first, Model(order, other, none, none, {}, 1.0, 510.0))
    assert float(same.value) == pytest.approx(0.0, abs=1e-9)
    assert float(focal.value) == pytest.approx(2.0)
    moved, _ = apart("a", first, Model(np.roll(order, 1), other, none, none, {}, 1.0, 510.0))
    assert float(moved.value) > 1.0
    assert apart("a", first, replace(first, index=np.arange(5, 12))) == []


def test_both_times_are_from_images_in_memory_to_poses() -> None:
    """COLMAP's process also starts, and reads the images."""
    none = np.zeros((0, 3))
    theirs = Model(np.arange(2), np.tile(np.eye(4), (2, 1, 1)), none, none, {}, 30.0, 500.0, solving_seconds=20.0)
    rows = {row.name: row for row in beside("a", [], Solved([], 8.0), theirs, "")}
    assert rows["a: processor time, COLMAP"].value == 20.0
    assert rows["a: processor time over COLMAP's"].value == pytest.approx(0.4)
