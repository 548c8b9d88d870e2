"""Runs side by side: each figure once, differences against the first, the same keyframes beside each other."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from launch.comparison import compared, comparison_text, names
from launch.compose import compose
from launch.named_input import quoted
from mvsgs.compare import main as compare
from mvsgs.evaluate import main as evaluate
from mvsgs_core.evaluation import metrics
from mvsgs_core.evaluation.common_frames import different, one_input, seconds_of
from mvsgs_core.evaluation.metrics import Figure
from mvsgs_core.evaluation.side_by_side import chosen
from mvsgs_core.export.cameras import read_cameras, write_cameras
from mvsgs_core.export.keyframe_images import write_image
from tests.support.chromium import browser
from tests.support.tiny_map import INTRINSICS, SIZE, write_tiny_run


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


def test_how_many_frames_the_figures_are_of_is_said(tmp_path: Path) -> None:
    """A run that lost half of its frames has the better figures."""
    runs = []
    for name, psnr, held_out, tracked in (("whole", 30.0, 20, 100), ("half", 32.0, 8, 41)):
        rendering = {"held_out": {"psnr": psnr, "count": held_out}, "keyframes": {"psnr": 33.0, "count": 2 * held_out}}
        trajectory = {"frames_tracked": tracked}
        runs.append(scored(tmp_path / name, psnr, 1000, rendering=rendering, trajectory=trajectory))
    rows = {row[0]: row[1:] for row in compared(runs)}
    assert rows["held-out frames scored"] == ["20", "8 (-12)"]
    assert rows["keyframes scored"] == ["40", "16 (-24)"]
    assert rows["frames tracked"] == ["100", "41 (-59)"]


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
    assert page.count("data:image/jpeg;base64,") == 9  # of three keyframes, two runs and their difference
    assert ">keyframe 7</p>" in page
    assert '<td class="better">31.25 (+1.25)</td>' in page
    assert "http:" not in page
    assert "https:" not in page


def begun_later(run: Path, keyframes: int, **more: Any) -> None:
    """Makes of a tiny run one whose dataset.start left out so many of its keyframes: indices count from there."""
    cameras = read_cameras(run / "cameras.json").chosen(slice(keyframes, None))
    write_cameras(run / "cameras.json", replace(cameras, keyframes=cameras.keyframes - cameras.keyframes[0], **more))


def with_report(run: Path, /, **more: Any) -> None:
    (run / "report.json").write_text(json.dumps(json.loads((run / "report.json").read_text()) | more))


def test_keyframes_are_the_same_by_their_time_and_not_by_their_index(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = runs
    begun_later(b, 1)
    for run, first in ((a, 30.0), (b, 20.0)):
        frames = [{"index": 7 * k, "psnr": first + k} for k in range(3)]
        with_report(run, rendering={"held_out": {"psnr": first, "count": 3}, "frames": frames})
    assert compare([*map(str, runs), "--html", str(tmp_path / "page.html")]) == 0
    said = "these runs are of different frames: their figures do not compare; give runs of the same input with the same"
    assert f"warning: {said}" in capsys.readouterr().out
    page = (tmp_path / "page.html").read_text()
    assert f'<p class="warning">{said}' in page
    assert 'class="better"' not in page
    assert 'class="worse"' not in page
    assert re.findall(r'<p class="row">([^<]*)', page) == [
        "keyframe 7 of a, 0 of b: PSNR a: 31.00 dB, b: 20.00 dB",
        "keyframe 14 of a, 7 of b: PSNR a: 32.00 dB, b: 21.00 dB",
    ]
    lines = [re.findall(r"([\d.]+),", line) for line in re.findall(r'polyline points="([^"]*)"', page)]
    np.testing.assert_allclose([float(x) for x in lines[1][:2]], [float(x) for x in lines[0][1:]])  # b's begins later


def test_runs_of_other_inputs_or_sizes_are_said_to_be_so(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run in runs:
        with_report(run, input="images walk", run={"frame_size": [24, 32]}, trajectory={"frames": 15})
    words = [*map(str, runs), "--html", str(tmp_path / "page.html")]
    for more, said, common in (
        ({}, "", True),
        ({"run": {"frame_size": [48, 64]}}, "different frame sizes:", True),
        ({"run": {"frame_size": [24, 32]}, "trajectory": {"frames": 30}}, "different frames:", True),
        ({"input": "images garden", "run": {"frame_size": [48, 64]}}, "different inputs and frame sizes:", False),
    ):
        with_report(runs[1], **more)
        assert compare(words) == 0
        shown, page = capsys.readouterr().out, (tmp_path / "page.html").read_text()
        assert said in shown
        assert said in page
        assert ("do not compare" in shown) == ("do not compare" in page) == bool(said)
        assert ('class="better"' in page) == (not said)
        assert ("These runs have no keyframe in common." not in page) == common


@pytest.mark.parametrize("name", ["walk.mp4", "a walk, (1) 'of' 5.mp4", "photos"])
def test_an_input_is_the_same_however_it_is_named(
    name: str, runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    home = tmp_path / "home"
    file = home / name
    file.mkdir(parents=True)
    (tmp_path / "link").symlink_to(home)
    monkeypatch.chdir(home)
    monkeypatch.setenv("HOME", str(home))
    words = [name, f"./{name}", f"{name}/", f"~/{name}", str(file), f"../home/{name}", str(tmp_path / "link" / name)]
    found = []
    for word in words:
        graph = compose(["dataset=images", f"dataset.path={quoted(word)}"])
        assert graph.slots["dataset"].config["path"] in (word, str(file))  # as it was given, but for the home
        found.append(graph.slots["evaluator"].config["input"])
    assert found[:5] == [f"images {file}"] * 5
    monkeypatch.chdir("/")
    for text in found:
        for run, given in zip(runs, (f"images {file}", text)):
            with_report(run, input=given)
        assert compare([*map(str, runs)]) == 0
        assert "different inputs" not in capsys.readouterr().out, text
    monkeypatch.chdir(home)  # as the reports of earlier versions have them
    assert one_input([{"input": f"images {word}"} for word in words if word[0] != "~"])
    assert one_input([{"input": name}, {"input": str(file)}])
    assert not one_input([{"input": f"images {name}"}, {"input": "images elsewhere"}])


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (["dataset=camera", "dataset.path='0'"], " 0"),
        (["dataset=camera", "dataset.path='rtsp://me:word@host/a?b=c,d'"], " rtsp://me:word@host/a?b=c,d"),
        (["dataset=camera", f"dataset.path=rtsp://host/{'a' * 5000}"], f" rtsp://host/{'a' * 5000}"),
        (["dataset=synthetic"], "synthetic "),
        (["dataset=tum", "dataset.path=gone/walk"], "tum gone/walk"),
    ],
)
def test_an_input_that_is_no_file_is_named_as_it_was(words: list[str], given: str) -> None:
    assert compose(words).slots["evaluator"].config["input"] == given


def test_the_error_is_against_a_photograph_of_the_same_size(runs: list[Path], tmp_path: Path) -> None:
    a, b = runs
    begun_later(b, 0, sizes=np.full((3, 2), (48, 64)), intrinsics=np.tile(2.0 * INTRINSICS, (3, 1)))
    words = [*map(str, runs), "--html", str(tmp_path / "page.html")]

    def pictures() -> list[str]:
        assert compare(words) == 0
        shown = (tmp_path / "page.html").read_text().split("keyframe 7<")[1].split('<p class="row">')[0]
        return re.findall('alt="([^"]*)"', shown)

    assert pictures() == ["a", "b", "b, of another size than a"]
    write_image(a / "keyframes", 7, np.full((*SIZE, 3), 200, np.uint8))
    assert pictures() == ["photograph", "a", "b", "a, error (x4)", "b, no photograph of its size was kept"]
    write_image(b / "keyframes", 7, np.full((48, 64, 3), 200, np.uint8))
    assert pictures() == ["photograph", "a", "b", "a, error (x4)", "b, error (x4)"]


def test_streams_differ_where_indices_and_times_do_not_go_together() -> None:
    def apart(a: dict[int, float], b: dict[int, float]) -> bool:
        return bool(different([{}, {}], [a, b]))

    whole = {0: 0.0, 4: 0.4, 9: 0.9}
    assert not apart(whole, {0: 0.0, 3: 0.3, 9: 0.9})  # other keyframes of the same frames
    assert not apart(whole, {})  # of which nothing is known
    assert apart(whole, {0: 3.0, 4: 3.4})  # start
    assert apart(whole, {0: 0.0, 2: 0.4, 5: 1.0})  # stride
    np.testing.assert_allclose(seconds_of(np.array([0, 2, 9, 11]), whole), [0.0, 0.2, 0.9, 1.1])


def test_the_keyframe_in_which_runs_differ_most_is_among_those_shown() -> None:
    common = list(range(0, 100, 10))
    scores = [dict.fromkeys(common, 30.0), {**dict.fromkeys(common, 30.5), 70: 20.0}]
    assert chosen(common, scores) == [0, 40, 70, 90]
    assert chosen(common, [{}, {}]) == [0, 40, 90]
    assert chosen([], [{}, {}]) == []


def test_better_is_what_the_metric_says() -> None:
    lower, higher = metrics.at("depth.abs_rel"), metrics.at("rendering.held_out.psnr")
    assert Figure("", lower, [0.02, 0.01, 0.03, 0.02000001, None]).better() == [None, True, False, None, None]
    assert Figure("", higher, [30.0, 31.0, 29.0]).better() == [None, True, False]
    assert Figure("", metrics.at("map.splats"), [1, 2]).better() == [None, None]


@pytest.mark.slow
def test_in_a_browser_all_is_within_the_screen_and_errors_stand_below_their_renders(
    runs: list[Path], tmp_path: Path
) -> None:
    for run in runs:
        write_image(run / "keyframes", 7, np.full((*SIZE, 3), 200, np.uint8))
    assert compare([*map(str, runs), "--html", str(tmp_path / "page.html")]) == 0
    left = "[...document.querySelectorAll('img')].filter(i => {}).map(i => Math.round(i.getBoundingClientRect().x))"
    with browser() as page:
        for width in (390, 1400):
            page.size(width, 900)
            page.open((tmp_path / "page.html").as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            renders, errors = (
                page.evaluate(left.format("i.alt == 'b'")),
                page.evaluate(left.format("/b, err/.test(i.alt)")),
            )
            assert len(renders) == 3
            assert errors == renders[1:2]  # of the keyframe whose photograph was kept
        assert page.evaluate("getComputedStyle(document.querySelector('.better')).color") == "rgb(47, 133, 90)"


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


def test_a_page_without_a_map_to_render_is_refused_and_says_what_to_do(
    runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (runs[1] / "map.ply").unlink()
    words = [str(run) for run in runs]
    assert compare([*words, "--html", str(tmp_path / "page.html")]) == 1
    said = capsys.readouterr().err
    assert f"{runs[1]}: map.ply is missing" in said
    assert "without --html the figures alone are compared" in said
    assert compare(words) == 0


def test_eval_shows_what_the_run_reached(runs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate([str(runs[0])]) == 0
    assert capsys.readouterr().out.startswith("held-out    PSNR 30.00 dB, 3 frames")
    assert evaluate([str(runs[0] / "map.ply")]) == 0
    (runs[0] / "report.json").unlink()
    assert evaluate([str(runs[0])]) == 1
    assert "no report.json there" in capsys.readouterr().err


def test_the_runs_of_a_sweep_are_found_in_its_folder(tmp_path: Path) -> None:
    from launch.sweep import SweepFolder, swept

    for name in ("0", "2", "10", "11", ".submitit"):
        (tmp_path / name).mkdir()
    os.utime(tmp_path / "11", (0, 0))  # of an earlier sweep
    SweepFolder().on_multirun_start(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
    assert [folder.name for folder in swept() if folder.parent == tmp_path] == ["0", "2", "10"]


def test_a_sweep_ends_with_its_runs_side_by_side(runs: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    from launch.run_all import side_by_side  # which puts the path in order

    side_by_side([runs[0]])
    assert capsys.readouterr().out == ""
    side_by_side([runs[0], runs[0].parent / "failed", runs[1]])
    assert "31.25 (+1.25)" in (runs[0].parent / "comparison.html").read_text()
    assert "31.25 (+1.25)" in capsys.readouterr().out


def test_eval_of_other_images_asks_how_well_the_map_explains_them(
    runs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    typed: list[str] = []

    def run_all(words: list[str]) -> int:
        typed.extend(words)
        return 0

    monkeypatch.setattr("mvsgs.evaluate.run_all", run_all)
    assert evaluate([str(runs[0] / "map.ply"), "walk.mp4", "dataset.stride=2"]) == 0
    assert typed == [f"map={runs[0]}", "mapper=frozen", "walk.mp4", "dataset.stride=2"]


@pytest.mark.parametrize("name", ["kitchen (2)", "kitchen, hall", "it's {here}"])
def test_eval_takes_a_map_in_a_folder_of_any_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    typed: list[str] = []
    monkeypatch.setattr("mvsgs.evaluate.run_all", lambda words: typed.extend(words) or 0)
    assert evaluate([f"runs/{name}", "walk.mp4"]) == 0
    assert OverridesParser.create().parse_override(typed[0]).value() == f"runs/{name}"
