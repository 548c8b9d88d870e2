"""What all live streams have in common: whose intrinsics frames tell, what is said where none can be used."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs import Frame, GroundTruth
from nodes.live import LiveSource

HINT = "is it switched on?"


class Brief(LiveSource):
    """Two frames, and nothing after them; or nothing at all."""

    _silence = "no usable frame"
    comes: Callable[[int], Frame] | None = None

    def _hint(self) -> str:
        return HINT

    def _open(self) -> None:
        self._sent = 0

    def _next(self, seconds: float) -> Frame | None:
        if self.comes is None or self._sent == 2:
            return None
        self._sent += 1
        self._presence.came()
        return self.comes(self._sent)

    def _framed(self, frame: Frame) -> Frame:
        return replace(frame, intrinsics=frame.intrinsics / 2)

    def _close(self) -> None:
        pass


def unusable(number: int) -> Frame:
    """The first for its time, the second for its camera."""
    intrinsics = np.array([25.0 if number == 1 else -1.0, 25, 15.5, 11.5])
    return Frame(0, 1e18 if number == 1 else 2.0, np.zeros((24, 32, 3), np.uint8), intrinsics)


def test_the_original_image_is_the_one_that_comes_whatever_its_sender_says() -> None:
    node, came = Brief(Brief.Config(stop=1)), np.array([25.0, 25, 15.5, 11.5])
    image = np.zeros((24, 32, 3), np.uint8)
    node.comes = lambda number: Frame(0, float(number), image, came, original_intrinsics=np.full(4, np.nan))
    (frame,) = (message for message in node.run() if isinstance(message, Frame))
    assert frame.intrinsics.tolist() == (came / 2).tolist()
    assert frame.original_intrinsics is not None
    assert frame.original_intrinsics.tolist() == came.tolist()


@pytest.mark.parametrize("wrong", [2.0 * np.eye(4), np.full((4, 4), np.nan), np.eye(4) + 1e200 * np.eye(4, k=3)])
def test_a_pose_that_comes_with_a_frame_goes_apart_from_it_and_one_that_is_none_is_left_out(wrong: np.ndarray) -> None:
    node, pose = Brief(Brief.Config(stop=2)), np.eye(4)
    pose[:3, 3] = [1.0, 2.0, 3.0]
    image, lens = np.zeros((24, 32, 3), np.uint8), np.array([25.0, 25, 15.5, 11.5])
    node.comes = lambda number: Frame(
        0, float(number), image + np.uint8(number), lens, world_from_cam=pose if number == 1 else wrong
    )
    sent = list(node.run())
    assert [message.world_from_cam for message in sent if isinstance(message, Frame)] == [None, None]
    first, second = (message.world_from_cam for message in sent if isinstance(message, GroundTruth))
    assert first is not None
    assert np.array_equal(first, pose)
    assert second is None
    assert node.stats.counts["refused_poses"] == 1
    assert any("no rotation and position" in text for text in node.stats.warnings)


def test_it_is_what_was_wrong_with_the_first_frame_not_that_none_came_after_it() -> None:
    node = Brief(Brief.Config(timeout=0.2))
    node.comes = unusable
    with pytest.raises(TimeoutError, match=r"^no usable frame for 0\.2 s: frames whose timestamp is no time"):
        list(node.run())
    assert any("was lost" in text for text in node.stats.warnings)


def test_it_is_what_to_look_at_where_nothing_came_whatever_the_mask_is_like(tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.full((24, 32), 255, np.uint8))
    node = Brief(Brief.Config(timeout=0.1, mask=str(mask)))
    assert "no black pixel" in node.stats.warnings[0]
    with pytest.raises(TimeoutError, match=rf"^no usable frame for 0\.1 s: {re.escape(HINT)}"):
        list(node.run())
