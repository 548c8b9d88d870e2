"""A map that a program saves, as the folder that a run would leave."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mvsgs.saving import save_map
from mvsgs_core.trajectory import Trajectory
from tests.support.small_atlas import PLAIN, begun


def test_the_trajectory_saved_is_of_the_part_that_is_saved(tmp_path: Path) -> None:
    """Six frames with the map's keyframes, and nine with a single one in another frame of reference."""
    index = np.arange(15)
    segment = np.isin(index, [3, *range(7, 15)]).astype(np.int32)
    poses = np.tile(np.eye(4), (15, 1, 1))
    track = Trajectory(index, index / 30, poses, index < 6, np.zeros(15, np.uint8), segment)
    atlas = begun(PLAIN)
    assert [view.index for view in atlas.largest.views] == [0, 1, 2, 4, 5]
    save_map(tmp_path, atlas, None, track, images=False)
    saved = np.loadtxt(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(saved[:, 0], np.flatnonzero(segment == 0) / 30, atol=1e-6)
