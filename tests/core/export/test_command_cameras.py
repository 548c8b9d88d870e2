"""The cameras that exports are of: every keyframe's own lens, and the poses of this stream only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core import camera
from mvsgs_core.export import __main__ as export
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.kept_map import STREAM
from mvsgs_core.trajectory_file import read_trajectory
from tests.support.tiny_map import INTRINSICS, cameras_around, write_tiny_run


def test_another_size_scales_the_lens_of_each_keyframe(tmp_path: Path) -> None:
    """Of a map of two cameras, say."""
    run, cameras = write_tiny_run(tmp_path / "run"), cameras_around([0.0, 0.5])
    sizes, lenses = np.array([[24, 32], [48, 32]]), np.array([INTRINSICS, [80.0, 40.0, 15.0, 24.0]])
    write_cameras(run / "cameras.json", replace(cameras, sizes=sizes, intrinsics=lenses))
    assert export.main([str(run), str(tmp_path / "cameras.json"), "--size", "12", "16"]) == 0
    again = read_cameras(tmp_path / "cameras.json")
    assert again.sizes.tolist() == [[12, 16], [12, 16]]
    for k in range(2):
        expected = camera.scale_intrinsics(lenses[k], (int(sizes[k, 0]), int(sizes[k, 1])), (12, 16))
        np.testing.assert_allclose(again.intrinsics[k], expected)


def test_a_trajectory_is_of_this_stream_and_says_what_it_leaves_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, cameras = write_tiny_run(tmp_path / "run"), cameras_around([0.0, 0.3, 0.6, 1.0])
    continued = replace(
        cameras, keyframes=np.array([7 - STREAM, 14 - STREAM, 0, 7]), timestamps=np.array([5.0, np.nan, np.nan, 1.0])
    )
    write_cameras(run / "cameras.json", continued)
    assert export.main([str(run), str(tmp_path / "poses.txt")]) == 0
    said = "1 poses; 3 keyframes of a stream before, or without a time, were left out"
    assert said in capsys.readouterr().out
    times, poses = read_trajectory(tmp_path / "poses.txt")
    assert times.tolist() == [1.0]
    np.testing.assert_allclose(poses[0], cameras.world_from_cam[3], atol=1e-6)
    assert "nan" not in (tmp_path / "poses.txt").read_text()
    write_cameras(run / "cameras.json", replace(continued, timestamps=np.full(4, np.nan)))
    assert export.main([str(run), str(tmp_path / "none.txt")]) == 1
    assert "no keyframe of this stream has a time" in capsys.readouterr().err
