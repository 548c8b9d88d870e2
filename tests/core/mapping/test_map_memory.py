"""Changing a large map takes little memory beyond the map's own: what a long run's memory is made of."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mvsgs_core.export.ply import read_ply, write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.geometry import Similarity
from mvsgs_core.mapping.deformation import move_with_anchors
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.splats import Splats

COUNT = 200_000
SIZE = COUNT * (3 * 15 * 4 + 4 + 8 + 4 + 4)  # bytes: values and moments, age, anchor, gradient, views
MMAP_THRESHOLD = -3  # of mallopt, malloc.h
RESET = Path("/proc/self/clear_refs")  # 5: the peak of the resident memory begins anew

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        sys.platform != "linux" or not os.access(RESET, os.W_OK) or not hasattr(ctypes.CDLL(None), "malloc_trim"),
        reason="peaks of resident memory are read as Linux with glibc gives them",
    ),
]


def splats(count: int) -> Splats:
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 1, 3), (count,)]
    return Splats(*(torch.ones(shape) for shape in shapes))


def full_map() -> MapState:
    """Every page of it is resident."""
    made = MapState(1, torch.device("cpu"))
    made.append(splats(COUNT), torch.arange(COUNT) % 7)
    for moments in (made.first, made.second):
        for value in moments.values():
            value.fill_(0.5)
    return made


def resident(kind: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024.0 for line in lines if line.startswith(f"{kind}:"))


def peak(work: Callable[[], object]) -> float:
    """Bytes beyond those before."""
    ctypes.CDLL(None).malloc_trim(0)
    before = resident("VmRSS")
    RESET.write_text("5")
    work()
    return resident("VmHWM") - before


def alone(measure: Callable[[], list[float]]) -> list[float]:
    """Runs in a new process, whose heap has no holes of other tests, and whose freed blocks go back at once."""
    with multiprocessing.get_context("spawn").Pool(1, _free_at_once) as pool:
        return pool.apply(measure)


def _free_at_once() -> None:
    assert ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, 1 << 18) == 1
    torch.set_num_threads(1)


def finished(count: int) -> Snapshot:
    return Snapshot(
        splats(count), np.zeros(count, np.int64), np.zeros(3), "gaussian", 0, np.zeros(0, np.int64),
        np.zeros((0, 4, 4)), np.zeros(0), np.zeros((0, 3, 4), np.float32),
    )  # fmt: skip


def _write_ply() -> list[float]:
    final = finished(COUNT)
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "map.ply", finished(10))  # PyTorch loads what it computes with the first time
        found = peak(lambda: write_ply(Path(folder) / "map.ply", final))
        assert len(read_ply(Path(folder) / "map.ply").splats) == COUNT
    return [found]


def _grow_and_shrink() -> list[float]:
    state = full_map()
    grown = peak(lambda: state.append(splats(10), torch.zeros(10, dtype=torch.int64)))
    assert len(state) == COUNT + 10
    assert state.splats.means.requires_grad
    return [grown, peak(lambda: state.keep(torch.arange(len(state)) % 100 > 0))]


def _correct() -> list[float]:
    state = full_map()
    turned = Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
    found = peak(lambda: move_with_anchors(state, dict.fromkeys(range(6), turned)))
    moved = state.splats.means.detach()
    np.testing.assert_allclose(moved[-1 - (COUNT - 1) % 7].numpy(), [-1.0, 4.0, 5.0])
    rest = moved[state.anchors == 6]
    assert (rest == 1.0).all()
    assert (moved[state.anchors < 6] == torch.tensor([-1.0, 4.0, 5.0])).all()
    return [found]


def test_a_map_whose_splats_all_stay_is_not_copied() -> None:
    state = full_map()
    kept = state.splats.means
    state.keep(torch.ones(len(state), dtype=torch.bool))
    assert state.splats.means is kept


def test_a_map_is_written_in_parts() -> None:
    assert alone(_write_ply)[0] < 0.3 * SIZE  # at once: 1.0


def test_growing_and_shrinking_replaces_one_tensor_after_the_other() -> None:
    grown, shrunk = alone(_grow_and_shrink)
    assert grown < 0.4 * SIZE
    assert shrunk < 0.4 * SIZE


def test_a_correction_moves_the_map_in_place() -> None:
    assert alone(_correct)[0] < 0.9 * SIZE
