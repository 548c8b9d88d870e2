"""Sizes that a user asks for: those on which nothing could be found are refused before a stage fails on them."""

from __future__ import annotations

import pytest

from mvsgs_core.datasets.framing import SMALLEST, Size, target_size


@pytest.mark.parametrize("size", [[8, 64], [64, 11], [11, 200], 64, 0, -300])
def test_a_size_with_a_side_too_small_is_refused(size: Size) -> None:
    with pytest.raises(ValueError, match=str(SMALLEST)):
        target_size(size, (480, 640))


@pytest.mark.parametrize(("size", "got"), [([12, 16], (12, 16)), (400, (16, 24)), ([24, 32], (24, 32))])
def test_small_ones_beyond_it_are_taken(size: Size, got: tuple[int, int]) -> None:
    assert target_size(size, (480, 640)) == got
