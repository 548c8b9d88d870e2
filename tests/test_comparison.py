"""Runs side by side: each figure once, differences against the first, the same keyframes beside each other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from launch.comparison import compared, comparison_text, names
from mvsgs.compare import common_keyframes
from mvsgs.compare import main as compare
from mvsgs.evaluate import main as evaluate
from mvsgs_core.export.cameras import read_cameras
from tests.support.tiny_map import write_tiny_run


def scored(folder: Path, psnr: float, splats: int, **more: Any) -> Path:
    run = write_tiny_run(folder)
    report = {
        "finished": True, "map": {"splats": splats, "bytes": 2e6},
        "rendering": {"held_out": {"psnr": psnr, "ssim": None, "count": 3}}, **more,
    }  # fmt: skip
    (run / "report.json").write_text(json.dumps(report))
    return run


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    return [scored(tmp_path / "a", 30.0, 1000), scored(tmp_path / "b", 31.25, 900, depth={"abs_rel": 0.02})]


def test_figures_stand_beside_each_other_with_their_differences(runs: list[Path]) -> None:
    rows = {row[0]: row[1:] for row in compared(runs)}
    assert rows[""] == ["a", "b"]
    assert rows["held-out PSNR, dB"] == ["30.00", "31.25 (+1.25)"]
    assert rows["splats"] == ["1,000", "900 (-100)"]
    assert rows["depth abs rel"] == ["–", "0.0200"]
    assert not any("SSIM" in name for name in rows)
    lines = comparison_text(runs).splitlines()
    assert len({len(line) for line in lines if not line.endswith("–")}) == 1


def test_runs_are_named_by_what_tells_them_apart(tmp_path: Path) -> None:
    assert names([tmp_path / "x/0", tmp_path / "x/1"]) == ["0", "1"]
    assert names([tmp_path / "one/out", tmp_path / "two/out"]) == ["one/out", "two/out"]
    assert names([tmp_path / "out", tmp_path / "out"]) == ["out", "out"]


def test_the_page_has_the_same_keyframes_of_all_runs(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare([*map(str, runs), "--html", str(tmp_path / "page.html")]) == 0
    assert "31.25 (+1.25)" in capsys.readouterr().out
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 6  # three keyframes of two runs
    assert "<b>keyframe 7</b>" in page
    assert "http" not in page
    cameras = read_cameras(runs[0] / "cameras.json")
    assert common_keyframes([cameras, cameras]) == [0, 7, 14]


def test_what_has_no_figures_is_said(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "none").mkdir()
    (runs[1] / "report.json").write_text('{"finished": false, "reason": "tracker failed"}')
    for words, said in (
        ([str(runs[0])], "give two runs or more"),
        ([str(runs[0]), str(tmp_path / "none")], "no report.json there; give the output folders of runs"),
        ([str(runs[0]), str(runs[1])], "that run has no figures: tracker failed"),
    ):
        assert compare(words) == 1
        assert said in capsys.readouterr().err


def test_eval_shows_what_the_run_reached(runs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate([str(runs[0])]) == 0
    assert capsys.readouterr().out.startswith("held-out    PSNR 30.00 dB, 3 frames")
    assert evaluate([str(runs[0] / "map.ply")]) == 0
    (runs[0] / "report.json").unlink()
    assert evaluate([str(runs[0])]) == 1
    assert "no report.json there" in capsys.readouterr().err


def test_a_sweep_ends_with_its_runs_side_by_side(runs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    from launch.run_all import side_by_side  # which puts the path in order

    side_by_side([runs[0]])
    assert capsys.readouterr().out == ""
    side_by_side([runs[0], runs[0].parent / "failed", runs[1]])
    assert "31.25 (+1.25)" in capsys.readouterr().out
