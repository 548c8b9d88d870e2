"""What of a fused depth map is kept: no filter but the confidence and the views that agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvsgs_core.fusion.backend import NativeFusionBackend
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig, fuse
from nodes import Node
from nodes.depth_fusion import DepthFusion
from nodes.learned_fusion import LearnedFusion
from tests.support.depth_views import view
from tests.support.plane_scene import look, true_depth

SIZE = (160, 224)  # where parallax is enough for a depth to be sure
CONFIG = FusionConfig(device="cpu", threads=1)


def fused(patch: slice | None = None, grown: slice | None = None, config: FusionConfig = CONFIG) -> FusedDepth:
    """A wall seen four times. patch: rows and columns that the reference alone sees elsewhere; grown: columns that all
    see before the wall."""
    views = [view(k, 0.3 * x, size=SIZE) for k, x in enumerate((0, 1, -1, 1.5))]
    if patch is not None:
        views[0].depth[patch, patch] *= 1.3
    if grown is not None:
        for one in views:
            one.depth[:, grown] *= 0.8
            one.confidence[:, grown] = 0.5
    return fuse(views[0], views[1:], config, NativeFusionBackend(1))


def test_kept_is_what_is_sure_and_agreed_on_and_each_rejection_is_counted() -> None:
    found = fused(slice(60, 70))
    sure = (found.unfiltered > 0) & (found.confidence >= CONFIG.confidence)
    np.testing.assert_array_equal(found.depth > 0, sure & (found.consistent >= 1))
    assert found.counts["kept"] == (found.depth > 0).sum() > 0.5 * found.depth.size
    assert found.counts["rejected: confidence"] == ((found.unfiltered > 0) & ~sure).sum() > 0


def test_what_is_counted_as_rejected_is_a_part_of_what_was_filtered() -> None:
    views = [view(k, 0.3 * x, size=SIZE) for k, x in enumerate((0, 1, -1, 1.5))]
    views[0].depth[:, 30:] = 0  # for the neighbors to fill
    found = fuse(views[0], views[1:], replace(CONFIG, confidence=1.0), NativeFusionBackend(1))
    assert found.counts["with depth"] == (found.unfiltered > 0).sum() > 2 * (views[0].depth > 0).sum()
    assert found.counts["rejected: confidence"] == found.counts["with depth"]


def test_one_view_that_must_agree_is_the_reference_itself() -> None:
    alone = replace(CONFIG, min_views=1, confidence=0.0, refine=False)
    found = fused(slice(60, 70), config=alone)
    assert (found.consistent[60:70, 60:70] == 0).any()
    np.testing.assert_array_equal(found.depth, found.unfiltered)
    unseen = fuse(found.view, [], alone, NativeFusionBackend(1))
    np.testing.assert_array_equal(unseen.depth, found.view.depth)
    assert not unseen.problem
    assert not fuse(found.view, [], CONFIG, NativeFusionBackend(1)).depth.any()


@pytest.mark.parametrize("node", [DepthFusion, LearnedFusion])
def test_no_view_that_must_agree_is_refused(node: type[Node]) -> None:
    with pytest.raises(ValueError, match="min_views=0: views that must agree"):
        node.check(node.Config(min_views=0))


def test_no_small_patch_that_one_view_alone_sees_gets_through() -> None:
    truth = true_depth(look(0.0), SIZE)
    found = fused(slice(60, 66))
    kept = found.depth[60:66, 60:66]
    assert ((kept == 0) | (np.abs(kept - truth[60:66, 60:66]) < 0.02 * truth[60:66, 60:66])).all()


def test_a_near_surface_is_less_sure_where_it_may_have_grown_over_what_lies_behind() -> None:
    """All views have it alike: none objects."""
    columns = slice(80, 140)
    found = fused(grown=columns)
    near = found.confidence[40:120, columns]
    rim, inside = near[:, 1:3], near[:, 20:40]
    assert np.median(rim) < np.median(inside) - 0.05
