"""What a large map costs is measured of it alone."""

from __future__ import annotations

import argparse
import os
from typing import Any

import numpy as np
import pytest

from bench import large
from bench.table import Row


def process() -> list[Row]:
    return [Row("process", os.getpid())]


@pytest.mark.slow
def test_what_is_measured_alone_has_a_process_of_its_own() -> None:
    numbers = {row.value for _ in range(2) for row in large.alone(process)}
    assert len(numbers) == 2
    assert os.getpid() not in numbers


@pytest.mark.parametrize("only", [None, "driven", "enlarged"])
def test_neither_measurement_is_in_the_memory_of_the_other(only: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Any] = []

    def alone(measured: Any, *given: int) -> list[Row]:
        started.append(measured)
        return []

    monkeypatch.setattr(large, "alone", alone)
    large.measure(argparse.Namespace(frames=None, keyframes=None, quick=True, only=only))
    assert started == [part for part in (large.enlarged, large.driven) if only in (None, part.__name__)]


def test_other_poses_in_a_large_map_miss_the_goal() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    assert large.alike(poses, poses.copy()).met is True
    assert large.alike(poses, poses + 1e-9).met is False
