"""What the launcher does to the directory of a run's results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from launch.compose import compose, graph_of
from launch.jobs import Job, _in_its_folder, _scored, unfinished
from launch.outcome import Outcome
from launch.output import Output, is_of_a_run, others_files, read_report
from launch.refusal import GraphError
from mvsgs_core.kept_map import STREAM
from mvsgs_core.mapping.checkpoints.files import CheckpointInfo
from mvsgs_core.trajectory_file import write_trajectory

HALFWAY = CheckpointInfo(Path("state-00000001.npz"), 40, 4.0, np.arange(5) * 10, 1000, finished=False)


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


def test_poses_without_a_map_are_worth_keeping(output: Output) -> None:
    output.begin({}, "mvsgs mapper=off", resumed=False)
    write_trajectory(output.path / "trajectory.txt", np.array([0.5]), np.eye(4)[None])
    output.begin({}, "mvsgs mapper=off", resumed=False)
    assert (output.path / "previous" / "trajectory.txt").exists()
    write_trajectory(output.path / "trajectory.txt", np.zeros(0), np.zeros((0, 4, 4)))
    assert output.begin({}, "mvsgs mapper=off", resumed=False) is None
    assert not (output.path / "previous-2").exists()


def test_where_earlier_results_went_and_how_many_there_are_is_said(output: Output) -> None:
    assert output.begin({}, "mvsgs", resumed=False) is None
    (output.path / "previous-notes").mkdir()  # the user's own
    for name, said in (("previous", "1 of them, 3 MB"), ("previous-2", "2 of them, 6 MB")):
        (output.path / "map.ply").write_bytes(bytes(3_000_000))
        assert output.begin({}, "mvsgs", resumed=True) is None
        moved = output.begin({}, "mvsgs", resumed=False)
        assert moved == f"what the run before found is now in {output.path / name} ({said})"


def test_what_goes_on_with_an_earlier_run_names_the_folder_where_it_is_now(
    output: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("launch.output.checkpoint_info", lambda folder: HALFWAY)
    output.begin({}, "mvsgs", resumed=False)
    (output.path / "map.ply").touch()
    output.settle(Outcome(1, "tracker failed"))
    before = read_report(output.path)
    assert before["resume"].endswith(f"resume={output.path}")
    output.begin({}, "mvsgs", resumed=False)
    after = read_report(output.path / "previous")
    assert after.pop("resume").endswith(f"resume={output.path / 'previous'}")
    assert after.items() <= before.items()


@pytest.mark.parametrize(
    ("found", "worth"),
    [
        (HALFWAY, True),
        (replace(HALFWAY, newest_keyframe_index=40 - STREAM), False),
        (replace(HALFWAY, newest_keyframe_index=40 - STREAM, finished=True), True),  # it is to be refined
    ],
)
def test_a_run_that_added_nothing_to_the_map_that_it_began_on_is_not_said_to_go_on(
    output: Output, monkeypatch: pytest.MonkeyPatch, found: CheckpointInfo, worth: bool
) -> None:
    monkeypatch.setattr("launch.output.checkpoint_info", lambda folder: found)
    output.begin({}, "mvsgs map=kept", resumed=False)
    output.settle(Outcome(1, "tracker failed"))
    assert (output.resume is not None) == worth
    assert ("run it again" in unfinished(output)) == (not worth)


def test_a_run_whose_order_cannot_be_taken_up_again_is_not_said_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs are registered in an order of their own; `resume=` would refuse."""
    monkeypatch.setattr("launch.output.checkpoint_info", lambda folder: HALFWAY)
    output = Output(tmp_path / "photographs", resumable=False)
    output.begin({}, "mvsgs", resumed=False)
    output.settle(Outcome(1, "mapper failed"))
    assert read_report(output.path)["resume"] is None
    assert output.resume is None


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


def test_runs_that_begin_in_the_same_second_get_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def job(output: str | None) -> Job:
        config = OmegaConf.create(compose([]).resolved | {"output": output})
        config.mapper.output = "${output}"
        return Job(config, [], {"dataset": "synthetic"}, None)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("launch.compose.time.strftime", lambda form: "now")
    folders = []
    for _ in range(3):
        one = job(None)
        graph = _in_its_folder(graph_of(one.config, one.overrides, one.choices), one)
        folders.append(Path(graph.settings.output))
        assert graph.slots["mapper"].config["output"] == graph.settings.output, "its stages write there, too"
    assert folders == [tmp_path / "runs" / name for name in ("now-synthetic", "now-synthetic-2", "now-synthetic-3")]
    assert all(folder.is_dir() for folder in folders)
    named = job(str(folders[0]))
    graph = graph_of(named.config, named.overrides, named.choices)
    assert _in_its_folder(graph, named) is graph, "a folder that was named is that one"


def test_what_killed_processes_left_half_written_goes(output: Output) -> None:
    (output.path / "checkpoint" / "keyframes").mkdir(parents=True)
    half = (
        ".report.17.json", ".map.4.ply", "checkpoint/.tracker.5.npz", "checkpoint/.state-00000002.5.npz",
        "checkpoint/keyframes/.000003-0a1b2c3d.5.png",
    )  # fmt: skip
    others = (".notes.17.json", ".report.json", ".report.old.json", "checkpoint/tracker.npz")
    for resumed in (True, False):
        for name in (*half, *others):
            (output.path / name).touch()
        output.begin({}, "mvsgs", resumed=resumed)
        assert [name for name in half if (output.path / name).exists()] == []
        assert [name for name in others[:3] if not (output.path / name).exists()] == []
    with pytest.raises(GraphError, match="is writing there"):
        Output(output.path)  # of a run that is under way: who comes second does not get as far


def test_only_the_evaluators_report_is_waited_for(output: Output) -> None:
    graph = compose(["evaluator=off", "viewer=viser", "recorder=mcap"])
    assert not _scored(graph)
    output.begin(graph.resolved, "mvsgs", resumed=False)
    output.settle(Outcome(), scored=_scored(graph))
    assert read_report(output.path)["finished"] is True
    assert _scored(compose(["evaluator=external"]))


@pytest.fixture
def never_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(path: Path) -> int:
        raise AssertionError(f"{path} would be written")

    monkeypatch.setattr("launch.output._lock", locked)


@pytest.mark.usefixtures("never_locked")
def test_neither_the_root_nor_the_home_folder_itself_is_an_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "root").symlink_to("/")
    for root in (Path("/"), Path("//"), tmp_path / "root"):
        with pytest.raises(GraphError, match=f"output={root}: is the root of the file system; .*such as {root}"):
            Output(root)
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    with pytest.raises(GraphError, match=f"output={home}: is your home folder; .* such as {home}/runs/first"):
        Output(home)
    (home / "report.json").write_text('{"finished": false}')  # of a run that is to be gone on with
    for folder in (home, home / "runs"):
        with pytest.raises(AssertionError, match="would be written"):
            Output(folder)


@pytest.mark.usefixtures("never_locked")
def test_a_file_in_the_way_of_the_output_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for path, said in ((file, "is a file"), (file / "a" / "b", f"{file} is a file")):
        with pytest.raises(GraphError, match=f"output={path}: {said}; give the name of a folder"):
            Output(path)


def test_a_path_at_home_is_one_whatever_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    # no shell takes the ~ of recorder.path=~/walk.mcap as it takes that of a word of its own
    monkeypatch.setenv("HOME", "/home/anna")
    graph = compose(["dataset=images", "dataset.path=~/photos", "recorder=mcap", "recorder.path=~/walk.mcap"])
    assert graph.resolved["recorder"]["path"] == "/home/anna/walk.mcap"
    assert graph.resolved["dataset"]["path"] == "/home/anna/photos"
