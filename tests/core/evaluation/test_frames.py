"""Which frames of a stream are there to be scored when it is over: even, bounded, the same whatever came when."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.evaluation.frames import ENDING, MIN_KEPT, Frames
from mvsgs_core.evaluation.thinning import Thinned
from mvsgs_core.held_out import is_held_out
from tests.support.full_disk import full_after

INTRINSICS = np.array([30.0, 30.0, 15.5, 11.5])
PLENTY = 1e9


def image(index: int, size: tuple[int, int] = (6, 8)) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (*size, 3), np.uint8)


def streamed(folder: Path, count: int, max_frames: int = 200, max_bytes: float = PLENTY, step: int = 1) -> Frames:
    frames = Frames(folder, max_frames, max_bytes)
    for index in range(0, count * step, step):
        frames.add(index, image(index), INTRINSICS, None)
    return frames


def test_a_short_stream_is_kept_whole(tmp_path: Path) -> None:
    frames = streamed(tmp_path, 300)
    photographs = frames.photographs()
    assert sorted(photographs) == list(range(300))
    for index in (0, 7, 299):
        np.testing.assert_array_equal(photographs[index].image(), image(index))
    assert frames.notes() == []
    frames.close()


@pytest.mark.slow
def test_a_hundred_thousand_frames_cost_bounded_disk_and_are_kept_evenly(tmp_path: Path) -> None:
    count = 100_000
    frames = Frames(tmp_path, 200, PLENTY)
    largest = 0
    for index in range(count):
        frames.add(index, image(index % 7), INTRINSICS, None)
        largest = max(largest, frames.size)
    assert largest < 2.5 * MIN_KEPT * 200  # bytes of a frame
    kept = np.array(sorted(frames.photographs()))
    assert kept[-ENDING:].tolist() == list(range(count - ENDING, count))
    for held_out in (True, False):
        same = np.array([index for index in kept[:-ENDING] if is_held_out(int(index)) == held_out])
        assert MIN_KEPT / 2 - 20 < len(same) <= MIN_KEPT
        gaps = np.diff([0, *same, count])
        assert gaps.max() < 4 * np.median(gaps)
        per_tenth = np.histogram(same, bins=10, range=(0, count))[0]
        assert per_tenth.max() - per_tenth.min() <= 6
    frames.close()


@pytest.mark.parametrize("step", [2, 3, 8, 25])
def test_a_stream_with_gaps_is_kept_evenly_too(tmp_path: Path, step: int) -> None:
    frames = streamed(tmp_path, 3000, max_frames=20, step=step)
    kept = np.array(sorted(frames.photographs()))
    per_fifth = np.histogram(kept[:-ENDING], bins=5, range=(0, 3000 * step))[0]
    assert per_fifth.min() > 0.75 * per_fifth.mean()
    assert len(kept) > MIN_KEPT / 2 - 20
    frames.close()


def test_what_is_kept_does_not_depend_on_when_keyframes_come(tmp_path: Path) -> None:
    chosen = []
    for delay in (0, 300):
        frames = Frames(tmp_path, 50, PLENTY)
        for index in range(2000 + delay):
            if index < 2000:
                frames.add(index, image(index), INTRINSICS, np.full((6, 8), 2.0, np.float32))
            keyframe = index - delay
            if keyframe >= 0 and keyframe % 3 == 1:
                frames.add_keyframe(keyframe, image(keyframe), INTRINSICS, np.ones((3, 4), np.float32), 1.0)
        depths = [index for index, _ in frames.filtered_depths()]
        true = [index for index in depths if frames.true_depth(index) is not None]
        assert len(true) > 50  # what two kinds keep is nested: keyframes with a true depth do not get rare
        chosen.append((sorted(frames.photographs()), depths, true))
        frames.close()
    assert chosen[0] == chosen[1]


def test_a_keyframe_whose_frame_was_dropped_is_there_as_it_was_mapped(tmp_path: Path) -> None:
    frames = Frames(tmp_path, 200, PLENTY)
    for index in range(10_000):
        frames.add(index, image(index), INTRINSICS, None)
    dropped = next(index for index in range(1, 100) if index not in frames.photographs())
    frames.add_keyframe(dropped, image(dropped), 2 * INTRINSICS, np.ones((3, 4), np.float32), 0.5)
    found = frames.photographs()[dropped]
    assert found.as_mapped
    np.testing.assert_array_equal(found.image(), image(dropped))
    np.testing.assert_array_equal(found.intrinsics, 2 * INTRINSICS)
    assert list(frames.filtered_depths()) == [(dropped, 0.5)]
    frames.close()


def test_a_frame_of_the_stream_goes_before_the_keyframe_made_of_it(tmp_path: Path) -> None:
    frames = streamed(tmp_path, 20)
    for index in (3, 19):  # on disk, and among the last
        frames.add_keyframe(index, 255 - image(index), 2 * INTRINSICS, np.ones((3, 4), np.float32), 1.0)
        assert not frames.photographs()[index].as_mapped
        np.testing.assert_array_equal(frames.photographs()[index].image(), image(index))
    frames.close()


def test_no_frame_is_kept_where_none_is_scored(tmp_path: Path) -> None:
    frames = streamed(tmp_path, 50, max_frames=0)
    frames.add_keyframe(3, image(3), INTRINSICS, np.ones((3, 4), np.float32), 1.0)
    assert frames.photographs() == {}
    assert list(frames.filtered_depths()) == []
    assert frames.size == 0
    frames.close()


def test_the_bound_on_bytes_holds_and_is_said(tmp_path: Path) -> None:
    bound = 30_000
    frames = Frames(tmp_path, 200, bound)
    for index in range(500):
        frames.add(index, image(index, (12, 16)), INTRINSICS, None)
        frames.add_keyframe(index, image(index, (12, 16)), INTRINSICS, np.ones((6, 8), np.float32), 1.0)
        assert frames.size <= bound
    assert frames.size > bound / 4
    notes = frames.notes()
    assert len(notes) == 3
    assert "evaluator.max_bytes=3e+04 was reached" in notes[0]
    assert "of 98 held-out frames could be kept" in notes[0]
    frames.close()


def test_not_even_one_frame_fits(tmp_path: Path) -> None:
    frames = streamed(tmp_path, 30, max_bytes=10)
    assert sorted(frames.photographs()) == list(range(25, 30))  # the last ones are in memory
    assert "0 of 4 held-out frames" in frames.notes()[0]
    frames.close()


def test_a_full_disk_costs_frames_and_is_said(tmp_path: Path) -> None:
    frames = Frames(tmp_path, 200, PLENTY)
    with full_after(2000):
        for index in range(60):
            frames.add(index, image(index), INTRINSICS, None)
    kept = sorted(frames.photographs())
    assert kept[0] == 0
    assert kept[-1] == 59
    assert len(kept) < 40
    for index in kept:
        np.testing.assert_array_equal(frames.photographs()[index].image(), image(index))
    assert any("other frames could not be kept to be scored: File too large" in note for note in frames.notes())
    frames.close()


def test_a_disk_that_fails_while_frames_are_thinned_out_loses_only_those(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: Thinned[None] = Thinned(tmp_path, 10, PLENTY)
    for index in range(10):
        kept.add(index, None, {"image": image(index)})
    written = []

    def refuse(data: bytes, offset: int) -> None:
        written.append(offset)
        if len(written) > 1:
            raise OSError(5, "Input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(kept._store, "_write", refuse)
        kept.add(10, None, {"image": image(10)})
    assert kept.lost == 1
    assert kept.error == "Input/output error"
    assert all(kept.get(index, "image") is not None for index in kept.notes)
    kept.close()
