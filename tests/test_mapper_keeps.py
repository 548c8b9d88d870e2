"""What the mapper node leaves on the disk while a stream runs: checkpoints, and maps that are asked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mvsgs_core.mapping.checkpoints.files import checkpoint_info
from nodes.mapper import Mapper
from tests.support.mapper_messages import settings, view_message
from tests.support.patience import LONG


def test_a_stream_that_pauses_is_saved_though_there_is_nothing_to_do(tmp_path: Path) -> None:
    node = Mapper(replace(settings(output=str(tmp_path)), realtime=True))
    for k in range(4):
        list(node.on_fused_keyframe(view_message(7 * k, k / 4)))
    while node.on_idle() is not None:
        pass
    checkpoints = node._checkpoints
    assert checkpoints is not None
    clock = checkpoints._clock
    checkpoints._clock = lambda: clock() + 3600.0
    for _ in range(20):
        assert node.on_idle() is None
        assert checkpoints._writer.wait(LONG)
    assert checkpoint_info(tmp_path).keyframes.tolist() == [0, 7, 14, 21]
    assert node.stats.counts["checkpoints"] == 2, "the first, and one of the map at rest"
