"""The long stream of the benchmark, and what is said of what grew on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.faults.hours import MAX_BYTES, Samples, _rows
from bench.faults.to_and_fro import ToAndFro
from bench.table import Row
from msgs import Frame, GroundTruth

COUNTS = {"keyframes": 20, "frames": 1000, "frames_tracked": 1000}


def rows(tracker: float, unnamed: float = 1.0) -> dict[str, Row]:
    """Of a run of 1,000 frames in 100 s, at the end of which the tracker holds so many MB more than before."""
    times = np.arange(0.0, 100.0, 0.5)
    samples = Samples(
        {
            "tracker": [(t, 100.0 + tracker * max(0.0, t - 20.0) / 80.0) for t in times],
            "mapper": [(t, 280.0) for t in times] + [(110.0, 400.0)],  # the last while it refines
        },
        [(t, 0.5) for t in times],
        [(t, unnamed) for t in times],
    )
    progress = [(n / 10.0, n) for n in range(50, 1001, 50)]
    return {row.name.partition(": ")[2]: row for row in _rows(samples, progress, COUNTS, 1000, 200)}


def test_what_grows_with_the_stream_misses_the_goal() -> None:
    found = rows(tracker=20.0)
    assert found["tracker: memory at the end over that after 200"].met is False
    assert found["mapper: memory at the end over that after 200"].met is True
    assert found["mapper: memory at the end over that after 200"].value == 1.0
    assert "peak of the run 400 MB" in found["mapper: memory at the end over that after 200"].unit
    assert rows(tracker=5.0)["tracker: memory at the end over that after 200"].met is True


def test_frames_on_disk_have_a_bound() -> None:
    assert rows(1.0, MAX_BYTES / 1e6)["frames that wait on disk to be scored, most"].met is True
    assert rows(1.0, 1.2 * MAX_BYTES / 1e6)["frames that wait on disk to be scored, most"].met is False


def test_the_camera_moves_to_and_fro_and_no_two_frames_are_equal(tmp_path: Path) -> None:
    progress = tmp_path / "progress"
    node = ToAndFro(ToAndFro.Config(frames=100, span=5, size=[18, 24], progress=str(progress)))
    messages = list(node.run())
    frames = [m for m in messages if isinstance(m, Frame)]
    poses = np.array([m.world_from_cam for m in messages if isinstance(m, GroundTruth)])
    assert [frame.index for frame in frames] == list(range(100))
    np.testing.assert_array_equal(poses[:8], poses[8:16])  # 0 1 2 3 4 3 2 1, and again
    np.testing.assert_array_equal(poses[1], poses[7])
    assert np.abs(np.diff(poses, axis=0)).max(axis=(1, 2)).min() > 0.0
    change = frames[8].image.astype(int) - frames[0].image.astype(int)
    assert 0 < np.abs(change).max() <= 4
    assert [line.split()[1] for line in progress.read_text().splitlines()] == ["50", "100"]
