"""A focal length that is only guessed: found where the motion shows it, kept with a warning where it does not."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.lens import guess_lens
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.frames import Path
from mvsgs_core.tracking.tracker import Tracker, Update
from tests.core.tracking.sequences import ate

SIZE = (240, 320)
GUESS = np.array(guess_lens(SIZE).intrinsics)


@functools.cache
def room(focal: float) -> tuple[Item, ...]:
    """The room through a lens with this focal length, in image widths."""
    sequence = Synthetic(frames=60, size=SIZE, threads=1)
    sequence.intrinsics = sequence.intrinsics * [focal / 0.8, focal / 0.8, 1.0, 1.0]
    return tuple(sequence)


@functools.cache
def straight() -> tuple[Item, ...]:
    """A camera that never turns: depths of any scale along the axis go with some focal length."""
    sequence = Synthetic(frames=2, size=SIZE, threads=1)
    items = []
    for n in range(45):
        pose = np.array(sequence[0].world_from_cam)
        pose[:3, 3] += pose[:3, :3] @ np.array([0.024, 0.008, 0.012]) * n
        items.append(Item(n, n / 20.0, sequence.render(pose, sequence.intrinsics, SIZE)[0], sequence.intrinsics, pose))
    return tuple(items)


def track_guessing(items: tuple[Item, ...]) -> tuple[Tracker, Path, list[Update]]:
    tracker = Tracker()
    updates = [tracker.add(i.index, i.timestamp, i.image, GUESS, guessed=True) for i in items]
    updates += tracker.finish()
    return tracker, tracker.path(), updates


@pytest.mark.parametrize("focal", [0.5, 1.3])  # fields of view of 90 and 42 degrees; the guess is 65
def test_the_focal_length_is_found(focal: float) -> None:
    items = room(focal)
    tracker, path, updates = track_guessing(items)
    true = focal * SIZE[1] / GUESS[0]
    assert abs(true - 1.0) > 0.3, "the guess must be wrong"
    assert tracker.focal_factor == pytest.approx(true, rel=0.03)
    error, length = ate(path, items)
    assert error < 0.004 * length
    assert np.isfinite(path.world_from_cam).all()
    told = [index for update in updates for index in update.keyframes]
    assert told == path.index[path.keyframe].tolist()
    assert "focal length" in tracker.stats.values
    assert tracker.stats.warnings == []


def test_keyframes_wait_until_the_focal_length_is_settled() -> None:
    tracker = Tracker()
    for item in room(1.3):
        update = tracker.add(item.index, item.timestamp, item.image, GUESS, guessed=True)
        if update.keyframes:
            break
        assert tracker.pending >= {k.index for k in tracker._keyframes()}, "an image that is still needed"
    settled = tracker.focal_factor
    assert len(update.keyframes) >= 8
    for later in room(1.3)[item.index + 1 :]:
        tracker.add(later.index, later.timestamp, later.image, GUESS, guessed=True)
        assert tracker.focal_factor == settled


def test_a_camera_that_never_turns_keeps_the_guess_and_says_so() -> None:
    tracker, path, _ = track_guessing(straight())
    assert tracker.focal_factor == 1.0
    assert any("guess is kept" in warning for warning in tracker.stats.warnings)
    assert path.keyframe.sum() >= 4


def test_a_known_focal_length_is_left_alone() -> None:
    tracker = Tracker()
    for item in room(0.5)[:40]:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    assert tracker.started
    assert tracker.focal_factor == 1.0
