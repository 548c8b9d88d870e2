"""How long keyframes wait for a preview: what is counted where those alone are read newest first."""

from __future__ import annotations

import time
from dataclasses import replace

from msgs import FusedKeyframe
from nodes.mapper import Mapper
from tests.support.mapper_messages import keyframe_message, settings, view_message


def test_a_keyframe_counts_as_shown_once_whether_it_was_read_without_its_depth_or_not() -> None:
    node = Mapper(replace(settings(), preview_period=1e-9, realtime=True))

    def fused(index: int) -> FusedKeyframe:
        return replace(view_message(index, index / 40), captured=time.time() - 1.0)

    def shown() -> int:
        return int(node.stats.values["latency"]["keyframe to preview"]["count"])

    list(node.on_fused_keyframe(fused(0)))
    node._previews.seconds = 0.0
    newest = replace(keyframe_message(40, 1.0), captured=time.time() - 1.0)  # those before it were not read
    list(node.on_keyframe(newest))
    assert shown() == 2
    for index in (10, 20, 30, 40):
        node._previews.seconds = 0.0
        list(node.on_fused_keyframe(fused(index)))
    assert shown() == 5
    node._previews.seconds = 0.0
    list(node.on_keyframe(newest))  # late
    assert shown() == 5
