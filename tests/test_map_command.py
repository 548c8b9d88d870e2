"""`map=DIR` and `keep_map=true`: what they compose, what they refuse, and a run that goes on in the map of another."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from launch.compose import compose
from launch.inline import run_inline
from launch.refusal import GraphError
from msgs import Asked, CameraPose, Frame, Reply, Request, SplatMap
from mvsgs_core.export.cameras import read_cameras
from mvsgs_core.kept_map import STREAM, tracker_file
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.maps.info import days_of, main
from mvsgs_core.maps.unfinished import what_is_missing
from nodes import Node
from nodes.frozen_mapper import FrozenMapper
from nodes.localization_file import HEADER
from nodes.localizer import Localizer
from nodes.mapper import Mapper
from nodes.tracker import Tracker
from tests.support.patience import LONG
from tests.support.small_atlas import PLAIN, begun, view

SMALL = (
    "device=cpu", "dataset.options.frames=80", "dataset.size=[120,160]", "mapper.iterations=8", "mapper.refinement=8",
    "mapper.threads=1", "evaluator.fitted=false",
)  # fmt: skip


def test_both_halves_of_a_map_are_told(tmp_path: Path) -> None:
    graph = compose([f"map={tmp_path}/a", f"output={tmp_path}/b"])
    for slot in ("tracker", "mapper"):
        assert graph.slots[slot].config["map"] == f"{tmp_path}/a"
        assert graph.slots[slot].config["keep_map"] is True, "a new map is written"
    assert compose([]).slots["mapper"].config["keep_map"] is False
    assert compose([f"map={tmp_path}/a", "keep_map=false"]).slots["tracker"].config["keep_map"] is False


def test_a_map_is_not_overwritten_by_its_own_run(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="another output"):
        compose([f"map={tmp_path}", f"output={tmp_path}"])
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "out")
    for read, written in (("link", "out"), ("out", "link"), ("out", "out/../out")):
        with pytest.raises(GraphError, match="another output"):
            compose([f"map={tmp_path / read}", f"output={tmp_path / written}"])
    (tmp_path / "loop").symlink_to("loop")
    assert compose([f"map={tmp_path / 'loop'}", f"output={tmp_path}"])  # for the nodes to refuse, which look inside


@pytest.mark.parametrize(
    ("stamps", "days"),
    [
        ((0.0, 3.5, 90_000.0), ""),  # of a file's beginning
        ((1_700_000_000.0, 1_700_000_009.0), "2023-11-14"),
        ((3.5, 1_700_000_000.0, 1_700_100_000.0), "2023-11-14 to 2023-11-16"),
        ((1.7e12, 1.7e18), ""),  # milliseconds, nanoseconds
    ],
)
def test_days_are_named_where_timestamps_are_a_clocks(stamps: tuple[float, ...], days: str) -> None:
    assert days_of(stamps) == days


@pytest.mark.parametrize("word", ["map=there", "keep_map=true"])
def test_a_tracker_that_keeps_no_map_is_refused(word: str) -> None:
    with pytest.raises(GraphError, match="tracker=dense"):
        compose([word, "tracker=ground_truth"])


def test_a_run_without_a_map_is_refused_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for node in (Tracker, Mapper):
        with pytest.raises(ValueError, match="keep_map=true"):
            node.check(node.Config(map=str(tmp_path)))
        with pytest.raises(ValueError, match="no such directory"):
            node.check(node.Config(map=str(tmp_path / "nowhere")))
    assert main([str(tmp_path)]) == 2
    assert "keep_map=true" in capsys.readouterr().err


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that keeps its map, shared by those that begin in it."""
    output = tmp_path_factory.mktemp("kept") / "first"
    run_inline(compose([*SMALL, "dataset.stop=40", "keep_map=true", f"output={output}"]))
    return output


def test_of_an_unfinished_runs_map_it_is_said_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reported(**content: Any) -> str | None:
        (tmp_path / "report.json").write_text(json.dumps(content))
        return what_is_missing(tmp_path)

    def tracked(*keyframes: int) -> None:
        known = SimpleNamespace(keyframes=[SimpleNamespace(index=index) for index in keyframes])
        monkeypatch.setattr("mvsgs_core.tracking.known_map.load", lambda file: known)

    frozen(tmp_path)  # of keyframes 0 to 5
    tracked(*range(8))
    assert "finish that one, and copy it again" in str(what_is_missing(tmp_path)), "a copy without the report"
    lacks = (
        "its run has not reached its end, 6 of the tracker's 8 keyframes have splats; "
        f"finish it first: mvsgs resume={tmp_path}"
    )
    assert reported(finished=False) == lacks
    for node in (Mapper, FrozenMapper):
        config = node.Config(map=str(tmp_path), threads=1, device="cpu")
        assert f"{tmp_path}: {lacks}" in list(node(config).stats.warnings)
    assert "run it again" in str(reported(finished=False, resume=None))
    assert reported(finished=False, map="finished") is None, "its report alone is missing"
    assert reported(finished=True) is None, "keyframes that were refused"
    (tmp_path / "report.json").unlink()
    tracked(*range(5))
    assert what_is_missing(tmp_path) is None, "saved on request"


@pytest.mark.slow
def test_a_run_goes_on_in_the_map_of_another(first: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    second = tmp_path / "second"
    assert tracker_file(first).is_file()
    assert len(list((first / "checkpoint").glob("state-*.npz"))) == 1, "the finished map alone"
    graph = compose([*SMALL, "dataset.start=40", f"map={first}", f"output={second}"])
    for slot in graph.slots.values():
        slot.node.check(slot.parameters)
    nodes = run_inline(graph)
    mapper, tracker = nodes["mapper"], nodes["tracker"]
    assert tracker.stats.counts["relocalized"] == 1
    assert tracker.stats.counts["frames while tracking"] == 40
    assert len(mapper.atlas.parts) == 1
    views = mapper.atlas.current.views
    known = read_cameras(first / "cameras.json").keyframes
    assert [view.index for view in views if view.index < 0] == (known - STREAM).tolist()
    assert any(view.index >= 0 for view in views)
    report = json.loads((second / "report.json").read_text())
    assert report["trajectory"]["frames_tracked"] == 40
    assert report["rendering"]["held_out"]["psnr"] > 22.0
    seconds = np.loadtxt(second / "trajectory.txt")[:, 0]
    assert (np.diff(seconds) > 0).all(), "that of this stream alone"
    assert main([str(second)]) == 0
    said = capsys.readouterr().out
    assert f"{len(views)} of the tracker" in said


@pytest.mark.slow
def test_frames_are_found_in_a_frozen_map(first: Path, tmp_path: Path) -> None:
    second = tmp_path / "second"
    before = {file: file.read_bytes() for file in first.rglob("*") if file.is_file()}
    words = ["mapper=frozen", "dataset.start=20", "dataset.stop=40", f"map={first}", f"output={second}"]
    nodes = run_inline(compose([*SMALL[:3], "mapper.threads=1", "evaluator.fitted=false", *words]))
    assert isinstance(nodes["tracker"], Localizer)
    assert nodes["tracker"].stats.counts["frames found in the map"] == 20
    lines = (second / "localization.csv").read_text().splitlines()
    assert lines[0] == HEADER
    rows = np.array([[float(word) for word in line.split(",")] for line in lines[1:]])
    assert rows[:, 0].tolist() == list(range(20))
    assert (rows[:, 9] > 0.5).all(), "confidences"
    report = json.loads((second / "report.json").read_text())
    assert report["rendering"]["held_out"]["count"] == 3
    assert report["rendering"]["held_out"]["psnr"] > 22.0
    assert {file: file.read_bytes() for file in first.rglob("*") if file.is_file()} == before
    assert not (second / "checkpoint").exists()


def test_a_frozen_map_chooses_the_tracker_unless_that_is_chosen(tmp_path: Path) -> None:
    words = ["mapper=frozen", f"map={tmp_path}"]
    assert compose(words).slots["tracker"].node is Localizer
    assert compose([*words, "tracker=dense"]).slots["tracker"].node is Tracker
    assert compose([f"map={tmp_path}"]).slots["tracker"].node is Tracker


@pytest.mark.parametrize("node", [Localizer, FrozenMapper])
def test_a_frozen_map_must_be_named(node: type[Node]) -> None:
    with pytest.raises(ValueError, match="map=DIR"):
        node.check(node.Config())


def frozen(folder: Path) -> FrozenMapper:
    """With a map of two parts."""
    writer = CheckpointWriter(folder, PLAIN)
    writer.submit(begun(PLAIN).frozen(), sync=False)
    assert writer.wait(LONG)
    tracker_file(folder).touch()
    return FrozenMapper(FrozenMapper.Config(map=str(folder), threads=1, device="cpu"))


def test_what_was_found_in_one_map_says_nothing_of_the_next(tmp_path: Path) -> None:
    node, given = frozen(tmp_path), view(3)
    list(node.on_frame(Frame(0, 0.0, np.asarray(given.image), given.intrinsics)))
    for index in range(3):
        list(node.on_camera_pose(CameraPose(index, 0.1 * index, given.world_from_cam, 0, None, 0.9)))
    (refused,) = node.on_request(Request(1, Asked.LOAD_MAP, folder=str(tmp_path / "none")))
    assert isinstance(refused, Reply)
    assert not refused.success
    assert node._mapper is node.atlas.parts[0], "the map is still that one"
    assert len(list(node.on_request(Request(2, Asked.LOAD_MAP, folder=str(tmp_path))))) == 1
    assert not list(node.on_camera_pose(CameraPose(0, 0.5, given.world_from_cam, 1, None, 0.9))), "an older frame"
    assert node._mapper is node.atlas.parts[1]
    again = list(node.on_request(Request(2, Asked.LOAD_MAP, folder=str(tmp_path))))
    assert not again, "by a tracker that was started again"
    assert node._mapper is node.atlas.parts[1]


def test_the_frozen_map_is_shown_with_the_camera_in_it(tmp_path: Path) -> None:
    node, given = frozen(tmp_path), view(3)
    splats = len(node.atlas.parts[0].state)
    list(node.on_frame(Frame(7, 0.7, np.asarray(given.image), given.intrinsics)))
    (shown,) = node.on_camera_pose(CameraPose(7, 0.7, given.world_from_cam, 0, None, 0.9))
    assert shown.index == 7
    assert shown.keyframes is not None
    assert shown.keyframes[-1] == 7
    assert (shown.keyframes[:-1] < 0).all()
    assert shown.render.shape == shown.image.shape
    assert not list(node.on_camera_pose(CameraPose(8, 0.8, given.world_from_cam, 0, None, 0.9))), "no frame of it came"
    (sent,) = node.on_end()
    assert isinstance(sent, SplatMap)
    assert len(sent.means) == splats
