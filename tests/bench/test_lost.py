"""What bench.lost makes of a sequence, and of what a run tells."""

from __future__ import annotations

import numpy as np
import pytest

from bench.lost import AWAY, ORDER, Seen, found_after, joined_after, of_returns, pieces, rows_of_returns
from bench.table import Row
from msgs import CameraPose, Frame, Keyframe, Poses
from mvsgs_core.datasets import Item
from mvsgs_core.trajectory import Trajectory

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


def test_a_camera_that_is_found_nowhere_misses_the_goal() -> None:
    """And a return that is no part of the map in the end is not counted among those that are."""
    seen = Seen()
    for frame in range(10):
        told(seen, frame, 0, keyframe=frame == 0)
    for frame in range(10, 30):
        told(seen, frame, None)
    returns = [range(10, 20), range(20, 30)]

    def rows(parts: list[int]) -> dict[str, Row]:
        none = np.zeros(30)
        seen.trajectory = Trajectory(
            np.arange(30), none, np.tile(EYE, (30, 1, 1)), none.astype(bool), none.astype(np.uint8), np.array(parts)
        )
        return {row.name.removeprefix("x: "): row for row in rows_of_returns("x", seen, returns, 0.1)}

    found = rows([0] * 30)
    assert found["of these relocalized as they came"].value == 0
    assert found["relocalized after, worst"].met is False
    for frame in range(20, 30):
        told(seen, frame, None if frame < 23 else 0)
    found = rows([0] * 30)
    assert found["relocalized after, worst"].value == pytest.approx(0.3)
    assert found["relocalized after, worst"].met is True
    elsewhere = rows([0] * 20 + [1] * 10)
    assert elsewhere["returns that are part of the map in the end"].value == "1 of 2"
    assert elsewhere["of these relocalized as they came"].value == 0
