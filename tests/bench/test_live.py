"""The benchmark of real time: its comparisons, its recordings, its slow stages."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import pytest

from bench.live.__main__ import FIXED, ONE_CORE, SLOW, WITHOUT, Result, below, efforts, rows_of_loss, rows_of_pace, run
from bench.live.recordings import SCENES, recording
from bench.live.slow import SlowFusion, SlowMapper, SlowStereo, slowed
from bench.pieces import Kept
from launch.compose import compose
from msgs import Frame
from nodes.player import Player


def report(psnr: dict[int, float], **parts: Any) -> Result:
    frames = [{"index": i, "psnr": value, "held_out": i % 5 == 0} for i, value in psnr.items()]
    return Result({"rendering": {"frames": frames}, "rendering_before_refinement": {"frames": frames}, **parts})


def test_maps_are_compared_on_the_held_out_frames_that_both_know() -> None:
    live, unhurried = report({0: 20.0, 1: 1.0, 10: 24.0}), report({0: 21.0, 1: 30.0, 5: 50.0, 10: 26.0})
    assert below(live, unhurried, refined=True) == pytest.approx(1.5)
    assert below(report({1: 20.0}), unhurried, refined=False) == float("inf")
    assert below(Result(None), unhurried, refined=False) == float("inf")


def test_a_run_that_failed_meets_no_goal() -> None:
    rows = rows_of_pace("x", Result(None))
    assert [row.met for row in rows if row.goal] == [False] * 4


def test_the_iterations_between_both_maps_are_said() -> None:
    live, unhurried = (
        report({0: 20.0}, map={"iterations": whole, "iterations_before_refinement": before})
        for whole, before in ((900, 200), (1900, 700))
    )
    said = {row.name: row.value for row in rows_of_loss("x", live, unhurried)}
    assert said["x: iterations from there to the refined map"] == "700 (1200 without hurry)"
    said = {row.name: row.value for row in rows_of_loss("x", Result(None), unhurried)}
    assert said["x: iterations from there to the refined map"] == "unknown (1200 without hurry)"


def test_without_the_governed_run_the_others_have_no_goal_to_meet() -> None:
    unhurried, nothing = report({0: 21.0}), Result(None)
    goal = below(nothing, unhurried, False) + 2.0
    for found in (nothing, report({0: 20.0})):
        rows = rows_of_loss("x", found, unhurried, goal)
        assert [row.met for row in rows if row.goal] == [False]


def test_only_a_finished_run_of_the_same_settings_is_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[str]] = []
    finished = iter((False, True, True, True))

    def start(command: list[str], **_: Any) -> None:
        ran.append(command)
        output = next(Path(word.removeprefix("output=")) for word in command if word.startswith("output="))
        (output / "report.json").write_text(json.dumps({"finished": next(finished), "run": len(ran)}))

    kept = Kept(True)
    monkeypatch.setattr("bench.live.__main__.recording", lambda *_: tmp_path / "room.mcap")
    monkeypatch.setattr("bench.live.__main__.subprocess.run", start)

    def reports(stop: int, *overrides: str) -> Any:
        options = argparse.Namespace(stop=stop, overrides=list(overrides))
        return run("room", ONE_CORE, tmp_path, options, kept).report

    assert reports(90) is None  # it ended early
    assert reports(90)["run"] == reports(90)["run"] == 2
    assert reports(60)["run"] == 3
    assert reports(60, "mapper.refinement=300")["run"] == 4
    assert len(ran) == 4


def test_goals_are_those_of_pose_and_map() -> None:
    latency = {
        "tracker": {"frame to pose": {"median": 0.02, "p99": 0.09}},
        "mapper": {"keyframe to map": {"median": 1.2, "p99": 3.5}},
    }
    counts = {"dataset": {"frames": 100}, "tracker": {"frames": 90, "keyframes": 12}, "mapper": {"views": 12}}
    skipped = {"mvs": {"effort on keyframes: half": 7, "hypotheses outside the range": 1e6}}
    found = report({0: 20.0}, latency=latency, counts=counts, skipped=skipped)
    rows = {row.name.removeprefix("x: "): row for row in rows_of_pace("x", found)}
    assert rows["frame to pose, 99 %, ms"].met is True
    assert rows["keyframes in the map"].met is True
    assert rows["keyframe to map, median, s"].met is True
    assert rows["keyframe to map, 99 %, s"].met is False
    assert rows["frames that a newer one overtook"].value == "10 of 100"
    assert efforts(found) == "half 7"


def test_every_way_is_one_that_the_launcher_takes() -> None:
    for way in (*FIXED, *WITHOUT):
        graph = compose(list(way.overrides))
        assert graph.slots["mvs"].parameters.efforts is not None
    for slot, (target, override) in zip(SLOW, zip((SlowStereo, SlowFusion, SlowMapper), SLOW.values()), strict=True):
        assert compose([override]).slots[slot].node is target


def test_a_recording_is_made_once_and_played_at_its_pace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"name": "synthetic", "size": [24, 32], "options": {"frames": 3}}
    monkeypatch.setitem(SCENES, "tiny", given)
    path = recording("tiny", tmp_path)
    made = path.stat().st_mtime_ns
    assert recording("tiny", tmp_path).stat().st_mtime_ns == made
    began = time.monotonic()
    played = [m for m in Player(Player.Config(path=str(path), realtime=True)).run() if isinstance(m, Frame)]
    assert time.monotonic() - began >= played[-1].timestamp - played[0].timestamp > 0.0
    due = [frame.captured - frame.timestamp for frame in played]
    assert max(due) - min(due) < 0.01
    assert abs(played[0].captured - time.time()) < 60.0
    assert all(m.captured == 0.0 for m in Player(Player.Config(path=str(path))).run())


def test_a_recording_of_another_size_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (32, 48):
        given = {"name": "synthetic", "size": [24, width], "options": {"frames": 2}}
        monkeypatch.setitem(SCENES, "tiny", given)
        played = Player(Player.Config(path=str(recording("tiny", tmp_path)))).run()
        assert {m.image.shape[1] for m in played if isinstance(m, Frame)} == {width}


def test_a_slow_stage_takes_that_many_times_as_long(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("bench.live.slow.time.sleep", slept.append)

    def work(answer: int) -> int:
        until = time.perf_counter() + 0.02
        while time.perf_counter() < until:
            pass
        return answer

    assert slowed(work, 10.0)(7) == 7
    assert slept[0] >= 9 * 0.02


def test_the_slow_stages_slow_what_they_are_paced_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the governor would not see it."""
    monkeypatch.setattr("bench.live.slow.time.sleep", lambda seconds: None)
    stereo = SlowStereo(SlowStereo.Config(realtime=True, threads=1))
    fusion = SlowFusion(SlowFusion.Config(realtime=True, threads=1, device="cpu"))
    mapper = SlowMapper(SlowMapper.Config(realtime=True, threads=1, device="cpu"))
    mapped = (mapper._add, mapper.atlas.step, mapper.atlas.begin_late)
    for slow in (stereo._core._estimate, fusion._core._fuse, *mapped):
        assert hasattr(slow, "__wrapped__")
