"""Which frames the evaluation holds out, and that these are not trained on, whatever tracker sends them."""

from __future__ import annotations

import numpy as np

from msgs import TrackedFrame
from mvsgs_core.held_out import is_held_out
from mvsgs_core.kept_map import STREAM
from nodes.mapper import Mapper
from tests.support.mapper_messages import settings, view_message


def test_every_fifth_frame_after_the_first_is_held_out_and_none_of_an_earlier_stream() -> None:
    assert [index for index in range(-20, 21) if is_held_out(index)] == [5, 10, 15, 20]
    assert not is_held_out(-STREAM)


def test_a_tracked_frame_that_is_held_out_is_refused() -> None:
    node = Mapper(settings())
    for index in (1, 11):
        list(node.on_fused_keyframe(view_message(index, index / 20)))
    for index in (0, 4, 5, 6, 10):
        view = view_message(index, index / 20)
        relative = np.linalg.inv(view_message(1, 0.05).world_from_cam) @ view.world_from_cam
        frame = TrackedFrame(index, view.timestamp, view.image, view.intrinsics, 1, relative, 1.0)
        list(node.on_tracked_frame(frame))
    list(node.on_end())
    assert [view.index for view in node.atlas.current.keyframes.between] == [0, 4, 6]
    assert node.stats.counts["refused_frames"] == 2
    assert len(node.stats.warnings) == 1
