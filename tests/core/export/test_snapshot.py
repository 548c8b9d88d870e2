"""What a saved map says of its size: the same of a room and of a street that is a hundred times as long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.export.keyframe_render import NEAR, near_plane
from mvsgs_core.export.picking import hit
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.rasterizer.splats import Splats


def street(step: float, count: int = 21, each: int = 5, depth: float = 10.0) -> Snapshot:
    """Keyframes every `step` along x, from the last to the first, each with splats `depth` before it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    anchors = np.repeat(np.arange(count), each)
    means = np.zeros((count * each, 3))
    means[:, 0], means[:, 2] = step * anchors, depth
    n = len(means)
    splats = Splats(
        torch.from_numpy(means).float(), torch.full((n, 3), -3.0), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.zeros(n), torch.zeros((n, 1, 3)), torch.full((n,), 2.0),
    )  # fmt: skip
    return Snapshot(
        splats=splats, anchors=10 * anchors, origin=np.zeros(3), kernel="gaussian", iterations=0,
        keyframes=10 * np.arange(count)[::-1], world_from_cam=poses[::-1].copy(), scale=np.ones(count),
        exposures=np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1)),
    )  # fmt: skip


@pytest.mark.parametrize("step", [0.1, 100.0])
def test_the_typical_depth_is_that_of_a_keyframe_however_long_the_street(step: float) -> None:
    final = street(step)
    assert final.typical_depth() == pytest.approx(10.0)
    for pose in (final.world_from_cam[0], final.world_from_cam[-1]):
        assert near_plane(final, pose) == pytest.approx(NEAR * 10.0)
    moved = replace(final, origin=np.array([5.0, 0.0, 0.0]), world_from_cam=final.world_from_cam + _along_x(5.0))
    assert moved.typical_depth() == pytest.approx(10.0)


def test_a_ray_meets_what_is_near_however_long_the_street() -> None:
    final = street(100.0)
    opaque = replace(final.splats, opacity_logits=torch.full_like(final.splats.opacity_logits, 5.0))
    found = hit(replace(final, splats=opaque), np.array([0.0, 0.0, 8.0]), np.array([0.0, 0.0, 1.0]))
    assert found is not None
    assert found[2] == pytest.approx(10.0, abs=0.1)


def test_without_keyframes_of_its_splats_none_is_known() -> None:
    final = street(1.0)
    foreign = replace(final, anchors=np.full(len(final.anchors), -1))
    assert foreign.typical_depth() is None
    assert near_plane(foreign, np.eye(4)) > 0


def _along_x(length: float) -> np.ndarray:
    shift = np.zeros((4, 4))
    shift[0, 3] = length
    return shift
