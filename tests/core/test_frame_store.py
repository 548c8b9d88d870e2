"""Arrays on disk: what goes in comes out, what is forgotten gives its room back, a full disk takes nothing along."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.frame_store import FrameStore
from tests.support.full_disk import full_after

RNG = np.random.default_rng(0)


def frame(index: int) -> dict[str, np.ndarray]:
    image = np.random.default_rng(index).integers(0, 256, (24, 32, 3), np.uint8)
    return {"image": image, "depth": np.random.default_rng(index).random((12, 16), np.float32)}


def check(store: FrameStore, indices: list[int]) -> None:
    for index in indices:
        for name, array in frame(index).items():
            found = store.get(index, name)
            assert found is not None
            assert found.dtype == array.dtype
            np.testing.assert_array_equal(found, array)


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    for index in range(5):
        store.put(index, frame(index))
    odd = {"view": RNG.integers(0, 256, (3, 24, 32), np.uint8).transpose(1, 2, 0), "row": RNG.random(7)}
    odd["negative"] = np.array([[-0.0, np.nan], [np.inf, -1e30]], np.float32)
    store.put(9, odd)
    check(store, list(range(5)))
    for name, array in odd.items():
        np.testing.assert_array_equal(store.get(9, name), array)
    assert store.get(9, "image") is None
    assert store.get(7, "image") is None
    store.close()


def test_a_photograph_takes_less_room_than_it_has_pixels(tmp_path: Path) -> None:
    y, x = np.mgrid[0:120, 0:160]
    image = np.dstack([x, y, x + y]).astype(np.uint8) + RNG.integers(0, 3, (120, 160, 3), np.uint8)
    store = FrameStore(tmp_path)
    store.put(0, {"image": image})
    assert store.size < 0.5 * image.nbytes
    np.testing.assert_array_equal(store.get(0, "image"), image)
    store.close()


def test_forgotten_frames_give_their_room_back(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    for index in range(20):
        store.put(index, frame(index))
    whole = store.size
    store.keep(range(0, 20, 4))
    assert store.size < 0.3 * whole
    check(store, [0, 4, 8, 12, 16])
    assert store.get(1, "image") is None
    store.put(30, frame(30))
    check(store, [0, 4, 8, 12, 16, 30])
    store.close()


def test_a_frame_that_comes_again_and_again_takes_the_room_of_a_few(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    store.put(0, frame(0))
    one = store.size
    for _ in range(50):
        store.put(0, frame(0))
    assert store.size < 3.5 * one
    check(store, [0])
    store.close()


def test_no_file_has_a_name_and_closing_gives_the_room_back(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    store.put(0, frame(0))
    assert not list(tmp_path.iterdir())
    store.close()
    assert store.size == 0
    assert store.get(0, "image") is None


def test_a_full_disk_refuses_a_frame_and_keeps_the_others(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    store.put(0, frame(0))
    store.put(1, frame(1))
    with full_after(store.size + 100), pytest.raises(OSError, match="File too large"):
        store.put(2, frame(2))
    check(store, [0, 1])
    assert store.get(2, "image") is None
    file = store._file
    assert file is not None
    assert os.fstat(file.fileno()).st_size == store.size  # the part that was written is given back
    store.put(3, frame(3))
    check(store, [0, 1, 3])
    store.close()
