"""The embedded scene as a data set."""

from __future__ import annotations

import pytest

from mvsgs_core.datasets import open_dataset


def test_a_number_of_pixels_is_a_size_as_of_any_other_data_set() -> None:
    (item,) = open_dataset("synthetic", size=19200, frames=1)
    assert item.image.shape == (120, 160, 3)


@pytest.mark.parametrize("size", [30, [3, 4], [60, 80, 3]])
def test_a_size_that_is_none_is_refused(size: object) -> None:
    with pytest.raises(ValueError, match="size"):
        open_dataset("synthetic", size=size)
