"""What differs from its annotations is refused where it is sent, in one process or between two, and leaves no gap."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from launch.compose import compose
from launch.inline import run_inline
from msgs import Depth, Frame, FusedKeyframe, Keyframe, Poses, TrackedFrame
from msgs.codec import CodecError
from mvsgs import Mapping
from nodes import Node
from nodes.runtime.transport import NewestReader, Publisher, ReliableReader
from tests.support.patience import LONG, until
from tests.support.sequences import synthetic

FAKE = Path(__file__).parent / "support" / "fake_graph" / "conf"
FRAME = Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), np.ones(4))


class Bright(Node):
    """Images from 0 to 1, as networks take them."""

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        image, grid = (frame.image / 255.0).astype(np.float32), np.ones((2, 2), np.float32)
        yield Keyframe(frame.index, frame.timestamp, image, frame.intrinsics, np.eye(4), 1.0, grid, grid, 0)


class Doubled(Node):
    """Depth in numpy's own precision."""

    def on_depth(self, message: Depth) -> Iterator[FusedKeyframe]:
        found = {"depth": message.depth.astype(np.float64), "normals": np.zeros((*message.depth.shape, 3), np.float32)}
        yield FusedKeyframe(**vars(message) | found)

    def on_poses(self, poses: Poses) -> Iterator[Poses]:
        yield poses

    def on_tracked_frame(self, frame: TrackedFrame) -> Iterator[TrackedFrame]:
        yield frame


def test_in_one_process_a_message_is_checked_as_between_two(tmp_path: Path) -> None:
    graph = compose([f"relay._target_={__name__}.Bright", f"output={tmp_path}"], FAKE)
    seen: list[str] = []
    with pytest.raises(CodecError, match=r"^relay: Keyframe\.image must be uint8, not float32"):
        run_inline(graph, lambda slot, node, message: seen.append(slot))
    assert seen == ["source"]


@pytest.mark.slow
def test_a_program_s_own_node_is_checked_too() -> None:
    items = synthetic(frames=26, size=(96, 128))
    small = ("mapper.iterations=2", "device=cpu", "mapper.threads=1", f"depth_fusion._target_={__name__}.Doubled")
    mapping = Mapping(*small, poses=True, intrinsics=items[0].intrinsics)

    def feed() -> None:
        for item in items:
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)

    with pytest.raises(CodecError, match=r"^depth_fusion: FusedKeyframe\.depth must be float32, not float64"):
        feed()
    with pytest.raises(RuntimeError, match="the stream was ended by CodecError"):
        mapping.finish()


def test_a_message_that_was_refused_is_not_missed(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/s"
    got: list[int] = []
    with (
        closing(Publisher(address)) as publisher,
        closing(ReliableReader(address, Frame)) as reader,
        closing(NewestReader(address, Frame)) as newest,
    ):
        until(lambda: publisher.ready(2))
        publisher.send(FRAME)
        assert newest.receive(LONG) is not None
        with pytest.raises(CodecError, match="must be uint8"):
            publisher.send(replace(FRAME, image=FRAME.image / 255.0))
        publisher.send(replace(FRAME, index=1))
        assert newest.receive(LONG).index == 1
        assert newest.skipped == 0
        until(lambda: (message := reader.take()) is not None and (got.append(message.index), message.index == 1)[1])
    assert got == [0, 1]
