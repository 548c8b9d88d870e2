"""`resume=DIR`: what is made of an interrupted run's configuration, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from launch.compose import compose, graph_of
from launch.graph import Graph
from launch.jobs import _kept
from launch.refusal import GraphError
from launch.resume import leave_out_refused, resumed_config
from launch.settings import BUFFER
from launch.settings_file import lasting
from mvsgs_core.mapping.checkpoints.files import state_file, write_state
from tests.support.shared_data import ROOT

META = {
    "newest_view": 95, "stream_seconds": 4.75, "splats": 10, "stream_ended": False, "revision": 1, "refined": 0,
}  # fmt: skip


def interrupted(folder: Path, *overrides: str, report: str = '{"finished": false}') -> Path:
    """What a run leaves that was killed after its checkpoint of keyframes 0, 5, ..., 95."""
    graph = compose([*overrides, f"output={folder}"])
    folder.mkdir(exist_ok=True)
    OmegaConf.save(OmegaConf.create(lasting(graph)), folder / "config.yaml")
    (folder / "report.json").write_text(report)
    state = state_file(folder, 3)
    state.parent.mkdir()
    write_state(state, META, {"keyframes": np.arange(0, 100, 5)})
    return folder


def resumed(folder: Path, *overrides: str) -> Graph:
    return graph_of(resumed_config(folder, overrides), overrides, {})


def test_a_stream_that_can_be_read_again_runs_through_the_whole_graph(tmp_path: Path) -> None:
    before = compose([f"output={tmp_path}", "mapper.iterations=7", "viewer=viser", "dataset.options.frames=33"])
    after = resumed(interrupted(tmp_path, "mapper.iterations=7", "viewer=viser", "dataset.options.frames=33"))
    assert after.slots.keys() == before.slots.keys()
    assert set(after.edges) == set(before.edges)
    assert after.slots["dataset"] == before.slots["dataset"]
    assert after.slots["mapper"].config == before.slots["mapper"].config | {"resume": str(tmp_path)}
    assert after.slots["mvs"].config["resume_after"] == 15  # of 20 keyframes the last 16 are neighbors of new ones
    assert after.settings.output == str(tmp_path)
    assert after.observers == before.observers


@pytest.mark.slow
def test_a_stream_that_is_gone_leaves_the_checkpoint_to_be_refined(tmp_path: Path) -> None:
    after = resumed(interrupted(tmp_path, "dataset=camera", "recorder=mcap"))
    assert list(after.slots) == ["dataset", "mapper", "evaluator"]
    assert after.slots["dataset"].config == {"path": str(tmp_path)}
    assert {(e.message.__name__, e.sender, e.reader) for e in after.edges if e.reader == "evaluator"} == {
        ("GroundTruth", "dataset", "evaluator"),
        ("Trajectory", "dataset", "evaluator"),
        ("FusedKeyframe", "dataset", "evaluator"),
        ("SplatMap", "mapper", "evaluator"),
    }


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("dataset.stride=3", "dataset.stride=3 (was 1)"),
        ("dataset.start=2 dataset.hide_fixed=false", "dataset.start=2 (was 0), dataset.hide_fixed=False (was True)"),
        ("dataset.size=[48,64]", "dataset.size=[48, 64] (was [240, 320])"),
        ("dataset.options.scene=town", "dataset.options.scene=town (was room)"),
        ("dataset.stop=50", "dataset.stop=50 (was 80)"),
        ("dataset.path=elsewhere", "dataset.path=elsewhere (was null)"),
        ("dataset=tum", "dataset.name=tum (was synthetic)"),
        ("dataset=camera", "dataset=nodes.camera.Camera (was nodes.reader.Reader)"),
    ],
)
def test_other_frames_than_the_map_s_are_refused(words: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(GraphError) as refused:
        resumed_config(interrupted(tmp_path, "dataset.stop=80"), words.split())
    assert said in str(refused.value)
    assert "leave that out, or begin another run with output=DIR" in str(refused.value)


@pytest.mark.parametrize(
    "words",
    ["dataset.stop=null", "dataset.stop=90", "dataset.realtime=true", "dataset.options.threads=1", "dataset.stride=1"],
)
def test_the_same_frames_and_later_ones_are_taken(words: str, tmp_path: Path) -> None:
    assert "dataset" in resumed(interrupted(tmp_path, "dataset.stop=80"), *words.split()).slots


def test_a_file_that_has_moved_is_found_where_it_is_now(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).touch()
    folder = interrupted(tmp_path / "run", "dataset=player", f"dataset.path={tmp_path / 'a.mcap'}")
    (tmp_path / "link.mcap").symlink_to("a.mcap")
    assert resumed(folder, f"dataset.path={tmp_path / 'link.mcap'}").slots
    with pytest.raises(GraphError, match="leave that out"):
        resumed(folder, f"dataset.path={tmp_path / 'b.mcap'}")
    (tmp_path / "a.mcap").unlink()
    assert resumed(folder, f"dataset.path={tmp_path / 'b.mcap'}").slots


def test_the_map_is_refined_alone_where_that_is_asked_for(tmp_path: Path) -> None:
    after = resumed(interrupted(tmp_path), "dataset=resumed")
    assert list(after.slots) == ["dataset", "mapper", "evaluator"]
    assert after.slots["dataset"].config == {"path": str(tmp_path)}


def test_a_name_that_is_too_long_for_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"^resume=.*: File name too long$"):
        resumed_config(tmp_path / ("a" * 300), ())


def test_a_recording_that_is_there_is_not_written_again(tmp_path: Path) -> None:
    (interrupted(tmp_path, "recorder=mcap") / "recording.mcap").touch()
    config = resumed_config(tmp_path, ())
    assert leave_out_refused(config) == [
        f"recorder is left out: path={tmp_path}/recording.mcap: that recording exists already; give another file"
    ]
    assert "recorder" not in graph_of(config, (), {}).slots


def test_overrides_hold_as_on_any_command_line(tmp_path: Path) -> None:
    overrides = ("mapper.refinement=9", "viewer=viser", "viewer.port=99", "seed=3")
    after = resumed(interrupted(tmp_path), *overrides)
    assert after.slots["mapper"].config["refinement"] == 9
    assert after.slots["viewer"].config["port"] == 99
    assert after.settings.seed == 3
    for wrong, why in (
        ("mapper.refinment=9", "did you mean refinement"),
        ("viewer=visr", "did you mean viser"),
        ("nothing=1", "no slot or key 'nothing'"),
        ("output=elsewhere", "resumed in its own directory"),
        ("~viewer", "only slot=choice"),
    ):
        with pytest.raises(GraphError, match=why):
            resumed(tmp_path, wrong)


def test_a_global_key_holds_in_every_slot(tmp_path: Path) -> None:
    """config.yaml has what each slot had of it."""
    interrupted(tmp_path, "device=cpu", "seed=1", "realtime=true")
    before = resumed(tmp_path)
    assert not _kept(before)
    assert before.slots["mapper"].config["seed"] == 1
    after = resumed(tmp_path, "mapper.seed=2", "keep_map=true", "seed=3", "realtime=false", "device=auto")
    assert after.slots["mapper"].config["keep_map"] is True
    assert _kept(after)
    assert (after.slots["mapper"].config["seed"], after.settings.seed) == (2, 3)
    assert after.slots["mapper"].config["realtime"] is False
    assert after.settings.buffer == BUFFER < before.settings.buffer
    assert any(edge.best_effort for edge in before.out_of("dataset"))
    assert not any(edge.best_effort for edge in after.out_of("dataset"))
    seeded = resumed(tmp_path, "seed=3")
    assert {slot.config["seed"] for slot in seeded.slots.values() if "seed" in slot.config} == {3}


def test_a_run_whose_directory_has_another_name_now_goes_on_in_it(tmp_path: Path) -> None:
    before = interrupted(tmp_path / "before", "recorder=mcap")
    after = before.rename(tmp_path / "after")
    graph = resumed(after)
    assert str(before) not in OmegaConf.to_yaml(OmegaConf.create(graph.resolved))
    assert graph.settings.output == graph.slots["tracker"].config["output"] == str(after)
    assert graph.slots["recorder"].config["path"] == f"{after}/recording.mcap"


def test_a_run_that_was_moved_aside_reads_what_stayed(tmp_path: Path) -> None:
    """A video in the folder that results were written to, from where another run has moved them."""
    scene = interrupted(tmp_path / "scene", "dataset=player", f"dataset.path={tmp_path / 'scene' / 'a.mcap'}")
    (scene / "a.mcap").touch()
    aside = scene / "previous"
    aside.mkdir()
    for path in [path for path in scene.iterdir() if path.name not in ("previous", "a.mcap")]:
        path.rename(aside / path.name)
    graph = resumed(aside)
    assert graph.slots["dataset"].config["path"] == str(scene / "a.mcap")
    assert graph.settings.output == graph.slots["tracker"].config["output"] == str(aside)


def test_a_file_of_a_relative_path_is_found_from_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap").touch()
    monkeypatch.chdir(tmp_path)
    interrupted(tmp_path / "run", "dataset=player", "dataset.path=a.mcap")
    monkeypatch.chdir("/")
    assert resumed(tmp_path / "run").slots["dataset"].config["path"] == str(tmp_path / "a.mcap")


def test_what_cannot_be_resumed_is_refused_with_the_reason(tmp_path: Path) -> None:
    def refusal(folder: Path) -> str:
        with pytest.raises(GraphError) as refused:
            resumed_config(folder, ())
        return str(refused.value)

    assert "no such directory" in refusal(tmp_path / "nowhere")
    assert "no config.yaml there" in refusal(tmp_path)
    folder = interrupted(tmp_path, report='{"finished": true, "cut_off": {"dataset": "ended after 8 of 24 frames"}}')
    assert refusal(folder).endswith("ended after 8 of 24 frames: for all of it, run it again")
    (folder / "report.json").write_text('{"finished": true}')
    assert refusal(folder).endswith(
        "has reached its end (see " + str(folder / "report.json") + "): nothing is left to do"
    )
    (folder / "report.json").write_text("{")  # cut off: not finished
    assert resumed_config(folder, ()).mapper.resume == str(folder)
    state_file(folder, 3).write_bytes(b"nonsense")
    assert "is damaged" in refusal(folder)
    state_file(folder, 3).unlink()
    assert "has no checkpoint" in refusal(folder)
    for text in ("[1, 2]", "a: b: c", "dataset: {_target_: nowhere.Nobody}"):
        (folder / "config.yaml").write_text(text)
        write_state(state_file(folder, 3), META, {"keyframes": np.arange(1)})
        assert "config" in refusal(folder) or "no module 'nowhere'" in refusal(folder)


def test_a_parameter_that_there_is_not_is_refused_with_the_one_that_is_meant(tmp_path: Path) -> None:
    config = OmegaConf.load(interrupted(tmp_path) / "config.yaml")
    config.tracker.readout = config.tracker.pop("readout_time")
    OmegaConf.save(config, tmp_path / "config.yaml")
    with pytest.raises(GraphError, match=rf"^resume={tmp_path}: tracker.readout: .* \(did you mean readout_time\?\)"):
        leave_out_refused(resumed_config(tmp_path, ()))


def test_keyframes_in_an_order_of_their_own_are_not_resumed(tmp_path: Path) -> None:
    """What the map has is told by how far the stream has come."""
    with pytest.raises(GraphError, match="its tracker sends keyframes in an order of its own"):
        resumed(interrupted(tmp_path, "tracker=photographs"))


def test_a_refused_resume_touches_nothing(tmp_path: Path) -> None:
    folder = interrupted(tmp_path, report=json.dumps({"finished": True}))
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    command = [sys.executable, ROOT / "launch/run_all.py", f"resume={folder}"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path.parent)
    assert done.returncode == 2
    assert done.stderr.startswith("error: resume=")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
