"""What the launcher does to the directory of a run's results."""

from __future__ import annotations

from pathlib import Path

import pytest

from launch.compose import compose
from launch.jobs import _scored
from launch.outcome import Outcome
from launch.output import Output, is_of_a_run, others_files, read_report


@pytest.fixture
def output(tmp_path: Path) -> Output:
    return Output(tmp_path)


@pytest.mark.parametrize("names", [["map.ply", "georeference.json"], ["localization.csv"]])
def test_results_of_an_earlier_run_do_not_pass_for_the_new_ones(output: Output, names: list[str]) -> None:
    output.begin({}, "mvsgs", resumed=False)
    for name in names:
        (output.path / name).touch()
    output.begin({}, "mvsgs", resumed=False)
    assert [name for name in names if (output.path / name).exists()] == []
    assert {path.name for path in (output.path / "previous").iterdir()} == {*names, "report.json", "config.yaml"}


def test_no_later_run_costs_an_earlier_ones_map(output: Output) -> None:
    (output.path / "previous").mkdir()  # the user's own
    output.begin({}, "mvsgs", resumed=False)
    for said in ("good", "partial"):
        (output.path / "map.ply").write_text(said)
        output.begin({}, "mvsgs", resumed=False)
        for name in ("trajectory.txt", "cameras.json"):  # what a run that found nothing leaves
            (output.path / name).touch()
        (output.path / "keyframes").mkdir()
        for name in ("000003.png", "a note"):
            (output.path / "keyframes" / name).touch()
        output.begin({}, "mvsgs", resumed=False)
        assert not (output.path / "trajectory.txt").exists()
        assert [path.name for path in (output.path / "keyframes").iterdir()] == ["a note"]
        (output.path / "keyframes" / "a note").unlink()
        (output.path / "keyframes").rmdir()
    kept = {path.parent.name: path.read_text() for path in output.path.glob("*/map.ply")}
    assert kept == {"previous-2": "good", "previous-3": "partial"}
    assert is_of_a_run(output.path / "previous-2")
    assert list((output.path / "previous").iterdir()) == []


def test_what_no_run_has_left_is_not_touched(output: Output) -> None:
    (output.path / "checkpoint").mkdir()
    for name in ("transforms.json", "checkpoint/model.pt", "map.ply", "config.yaml"):
        (output.path / name).write_text("a user's")
    assert others_files(output.path) == ["map.ply", "checkpoint", "transforms.json", "config.yaml"]
    output.begin({}, "mvsgs", resumed=False)
    assert not (output.path / "previous").exists()
    assert (output.path / "checkpoint" / "model.pt").read_text() == "a user's"
    assert others_files(output.path) == []


def test_a_cameras_password_is_in_no_report_and_its_settings_are_their_owners(output: Output) -> None:
    secret, shown = "rtsp://me:p@ss:1@host/stream", "rtsp://host/stream"
    graph = compose(["dataset=camera", f"dataset.path='{secret}'"])
    output.begin(graph.resolved, f"mvsgs {secret} seed=1", resumed=False)
    text = (output.path / "config.yaml").read_text()
    assert text.startswith(f"# mvsgs {shown} seed=1\n")
    assert f"path: {secret}" in text  # to go on with it
    assert (output.path / "config.yaml").stat().st_mode & 0o077 == 0
    output.settle(Outcome(1, f"dataset failed: {secret} is gone"))
    assert read_report(output.path)["reason"] == f"dataset failed: {shown} is gone"
    output.begin(compose([]).resolved, "mvsgs", resumed=False)
    (output.path / "plain").touch()
    assert (output.path / "config.yaml").stat().st_mode == (output.path / "plain").stat().st_mode


def test_only_the_evaluators_report_is_waited_for(output: Output) -> None:
    graph = compose(["evaluator=off", "viewer=viser", "recorder=mcap"])
    assert not _scored(graph)
    output.begin(graph.resolved, "mvsgs", resumed=False)
    output.settle(Outcome(), scored=_scored(graph))
    assert read_report(output.path)["finished"] is True
    assert _scored(compose(["evaluator=external"]))
