"""Sizes that a user asks for, or images have: those on which nothing could be found are refused before a stage fails on
them."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset
from mvsgs_core.datasets.framing import SMALLEST, Framing, Size, target_size
from tests.support.dataset_folders import write_image


@pytest.mark.parametrize("size", [[8, 64], [64, 11], [11, 200], 64, 0, -300])
def test_a_size_with_a_side_too_small_is_refused(size: Size) -> None:
    with pytest.raises(ValueError, match=str(SMALLEST)):
        target_size(size, (480, 640))


@pytest.mark.parametrize(("size", "got"), [([12, 16], (12, 16)), (400, (16, 24)), ([24, 32], (24, 32))])
def test_small_ones_beyond_it_are_taken(size: Size, got: tuple[int, int]) -> None:
    assert target_size(size, (480, 640)) == got


@pytest.mark.parametrize("size", [(4, 100), (100, 4), (1, 1), (11, 300)])
def test_images_too_small_for_a_flow_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    for i in range(3):
        write_image(tmp_path / f"{i}.png", 50, size)
    with pytest.raises(BadFileError, match=f"images of {size[1]}x{size[0]} pixels are too small, 12 a side"):
        open_dataset("images", path=tmp_path)
    assert len(list(open_dataset("images", path=tmp_path, size=[24, 32]))) == 3


def test_a_crop_that_leaves_too_little_is_refused() -> None:
    assert Framing(crop=8).size_of((28, 40)) == (12, 24)
    with pytest.raises(BadFileError, match=r"40x27 pixels less 8 on each side .* or a smaller crop"):
        Framing(crop=8).size_of((27, 40))
