"""End to end: the real stages, as processes, on the embedded scene; a node from outside the repository."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launch.compose import compose
from launch.inline import run_inline
from msgs import Trajectory
from mvsgs_core.export.cameras import read_source_camera
from tests.support.shared_data import shared

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
# Small, so that starting the processes takes longer than the mapping.
SMALL = [
    "dataset=synthetic", "dataset.size=[120,160]", "dataset.options.frames=60", "device=cpu", "mapper.iterations=20",
    "mapper.refinement=100", "evaluator.lpips=off", "tracker.threads=1",
]  # fmt: skip


def run_all(folder: Path, *overrides: str, expect: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, ROOT / "launch/run_all.py", f"output={folder / 'out'}", *overrides],
        cwd=folder, capture_output=True, text=True, timeout=240, env={**os.environ, "PYTHONPATH": ""},
    )  # fmt: skip
    assert done.returncode == expect, done.stdout + done.stderr
    return done


def report(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "out" / "report.json").read_text())
    return content


def positions(path: Path) -> np.ndarray:
    return np.loadtxt(path)[:, :4]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run of the default graph, shared by the tests that look at it: its folder, what it printed."""
    folder = tmp_path_factory.mktemp("room")
    return folder, run_all(folder, *SMALL).stdout


def test_the_room_is_mapped(room: tuple[Path, str]) -> None:
    scores = report(room[0])
    assert scores["rendering"]["keyframes"]["psnr"] > 24
    assert scores["rendering"]["held_out"]["psnr"] > 24
    assert scores["rendering"]["held_out"]["count"] >= 3
    assert scores["trajectory"]["frames"] == 60
    assert scores["trajectory"]["frames_tracked"] >= 50
    track = positions(room[0] / "out" / "trajectory.txt")
    assert np.isfinite(track).all()
    assert scores["trajectory"]["ate_percent"] < 2  # of the path
    # At 160x120 over a short path the ratio of depth to motion is weak: a part of each can look like the other.
    assert scores["depth"]["abs_rel"] < 0.3
    assert scores["depth"]["completeness"] > 0.2


def test_the_camera_is_in_the_output(room: tuple[Path, str]) -> None:
    camera = read_source_camera(room[0] / "out" / "cameras.json")
    assert camera is not None
    assert (camera.origin, camera.lens.size, camera.doubt) == ("given", (120, 160), "")
    assert camera.readout_time is not None


def test_the_same_command_gives_the_same_map(room: tuple[Path, str], tmp_path: Path) -> None:
    run_all(tmp_path, *SMALL, "evaluator._target_=null")
    maps = [(folder / "out" / "map.ply").read_bytes() for folder in (room[0], tmp_path)]
    assert maps[0] == maps[1]


def test_the_report_has_every_figure(room: tuple[Path, str]) -> None:
    scores = report(room[0])
    for rendering in ("rendering", "rendering_before_refinement"):
        for part in ("keyframes", "held_out", "all"):
            assert set(scores[rendering][part]) >= {"psnr", "ssim", "lpips", "count"}
    assert set(scores["trajectory"]) >= {"ate_rmse", "scale", "frames", "frames_tracked", "keyframes"}
    assert set(scores["depth"]) >= {"abs_rel", "inlier_ratio", "completeness"}
    assert scores["map"]["splats"] > 500
    assert scores["map"]["bytes"] == (room[0] / "out" / "map.ply").stat().st_size
    assert scores["time"]["wall"] > 0
    assert scores["time"]["keyframes_per_second"] > 0
    nodes = {"dataset", "tracker", "mvs", "depth_fusion", "mapper"}
    assert nodes <= set(scores["time"]["stages"])
    assert nodes <= set(scores["memory"]["peak_bytes"])
    assert isinstance(scores["skipped"], dict)


def test_every_file_is_there_and_named_on_the_screen(room: tuple[Path, str]) -> None:
    folder, printed = room
    for name in ("report.json", "report.html", "map.ply", "trajectory.txt", "config.yaml", "logs"):
        assert (folder / "out" / name).exists()
        assert name in printed
    assert "PSNR" in printed
    assert "ATE" in printed
    for name in ("dataset", "tracker", "mvs", "depth_fusion", "mapper", "evaluator"):
        assert (folder / "out" / "logs" / f"{name}.log").read_text()


def test_inline_tracks_exactly_as_the_processes_do(room: tuple[Path, str], tmp_path: Path) -> None:
    """The tracker hears nothing but frames, so that it must come to the same poses in both."""
    tracks: list[Trajectory] = []

    def observe(slot: str, node: object, message: object) -> None:
        if isinstance(message, Trajectory):
            tracks.append(message)

    run_inline(compose([*SMALL, "mapper._target_=null", "evaluator._target_=null", f"output={tmp_path}"]), observe)
    inline = np.column_stack([tracks[0].timestamp, tracks[0].world_from_cam[:, :3, 3]])
    np.testing.assert_allclose(inline, positions(room[0] / "out" / "trajectory.txt"), atol=1e-6)


def test_a_tracker_from_outside_the_repository(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "my_tracker.py", tmp_path)
    printed = run_all(
        tmp_path, *SMALL[:-1], "tracker._target_=my_tracker.Strided", "tracker.stride=6",
        "mapper.iterations=10", "mapper.refinement=20", "evaluator.max_frames=10", "evaluator.fitted=false",
    ).stdout  # fmt: skip
    scores = report(tmp_path)
    assert scores["trajectory"]["frames_tracked"] >= 50
    assert scores["trajectory"]["keyframes"] >= 8
    assert scores["trajectory"]["ate_rmse"] < 0.1
    assert scores["rendering"]["keyframes"]["psnr"] > 18
    assert "gets no Poses" in printed


def test_a_missing_sequence_is_explained(tmp_path: Path) -> None:
    failed = run_all(tmp_path, "dataset=tum", "dataset.path=nowhere", expect=2)  # before a process starts
    assert "error: dataset: nowhere is missing" in failed.stderr
    assert "rgb.txt" in failed.stderr  # the layout that is expected


def test_a_real_sequence_end_to_end(tmp_path: Path) -> None:
    path = shared("data/tum_fr1_xyz").resolve()
    run_all(
        tmp_path, "dataset=tum", f"dataset.path={path}", "dataset.stop=30", "dataset.size=[240,320]", "device=cpu",
        "mapper.iterations=10", "mapper.refinement=20", "evaluator.lpips=off", "evaluator.max_frames=10",
        "evaluator.fitted=false", "--inline",
    )  # fmt: skip
    scores = report(tmp_path)
    assert scores["trajectory"]["frames"] == 30
    assert scores["trajectory"]["frames_tracked"] >= 24
    assert scores["trajectory"]["ate_rmse"] < 0.05  # meters
    assert scores["rendering"]["keyframes"]["psnr"] > 16
