"""What bench.lost makes of a sequence, and of what a run tells."""

from __future__ import annotations

import numpy as np

from bench.lost import AWAY, ORDER, Seen, found_after, joined_after, of_returns, pieces
from msgs import CameraPose, Frame, Keyframe, Poses
from mvsgs_core.datasets import Item

EYE, ONE = np.eye(4), np.ones((2, 2), np.float32)
IMAGE, INTRINSICS = np.zeros((4, 4, 3), np.uint8), np.ones(4)


def item(index: int) -> Item:
    return Item(index, index / 30, IMAGE, INTRINSICS)


def test_the_camera_comes_back_elsewhere_and_what_is_between_is_gone() -> None:
    shown = pieces([item(n) for n in range(300)], AWAY)
    assert [piece.items[0].index // 50 for piece in shown] == list(ORDER)
    assert [len(piece.items) for piece in shown] == [50 if k == 5 else 40 for k in ORDER]
    assert [piece.away for piece in shown] == [0.0, *AWAY]
    assert [len(frames) for frames in of_returns(shown)] == [len(piece.items) for piece in shown[1:]]
    assert of_returns(shown)[0].start == 40


def told(seen: Seen, frame: int, segment: int | None, keyframe: bool = False) -> None:
    seen.note(Frame(frame, frame / 30, IMAGE, INTRINSICS))
    if segment is not None:
        seen.note(CameraPose(frame, frame / 30, EYE, segment, None, 1.0))
    if segment is not None and keyframe:
        seen.note(Keyframe(frame, frame / 30, IMAGE, INTRINSICS, EYE, 1.0, ONE, ONE, segment))


def test_a_return_is_found_in_the_map_or_joins_it_later() -> None:
    seen = Seen()
    for frame in range(10):
        told(seen, frame, 0, keyframe=frame == 0)
    for frame in range(10, 20):  # a part of its own
        told(seen, frame, None if frame < 15 else 1, keyframe=frame == 15)
    for frame in range(20, 30):
        told(seen, frame, None if frame < 23 else 0)
    assert found_after(seen, range(10, 20)) is None
    assert joined_after(seen, range(10, 20)) is None
    assert found_after(seen, range(20, 30)) == 3
    seen.note(Poses(1, np.array([15]), EYE[None], np.ones(1), np.zeros(1, np.int32)))
    assert joined_after(seen, range(10, 20)) == 19
