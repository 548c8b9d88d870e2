"""The tracking benchmark's own logic: fronts, memory, baselines, and a loop that a small map follows."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from bench.baselines import colmap_poses
from bench.baselines.colmap_poses import Model, load
from bench.pieces import Kept
from bench.tracking import baselines, curves, memory
from bench.tracking.__main__ import Result, rows_of
from bench.tracking.baselines import Baseline
from bench.tracking.cases import Case
from bench.tracking.curves import Point
from bench.tracking.memory import Sample
from mvsgs_core.datasets import Item
from mvsgs_core.trajectory import Trajectory


def test_the_default_is_on_the_front_unless_something_is_faster_and_better_by_more_than_noise(tmp_path: Path) -> None:
    points = [
        Point("default", "", 20.0, 1.0, 50), Point("size", "small", 10.0, 1.5, 50),
        Point("size", "odd", 19.9, 0.99, 50), Point("size", "bad", 30.0, 2.0, 50),
    ]  # fmt: skip
    rows = curves.rows("room", points)
    assert [r.unit.rsplit(", ", 1)[1] for r in rows[:4]] == [
        "not on the front", "on the front", "on the front", "not on the front",
    ]  # fmt: skip
    assert rows[-1].met
    assert curves.rows("room", [points[0], Point("flow", "dis", 9.0, np.nan, 0)])[1].value == "not tracked"
    worse = curves.rows("room", [*points, Point("window", "6", 15.0, 0.5, 50)])[-1]
    assert (worse.met, worse.value) == (False, "no: window 6")
    curves.draw(tmp_path / "room.svg", points)
    assert "odd" in (tmp_path / "room.svg").read_text()


def test_settings_of_the_curve_differ_from_the_default_and_from_each_other() -> None:
    configs = list(curves.settings().values())
    assert all(a != b for k, a in enumerate(configs) for b in configs[:k])


def test_memory_of_a_keyframe_that_grows_misses_the_goal() -> None:
    def met(end: float) -> bool | None:
        return memory.rows([Sample(500, 50, 100.0), Sample(2000, 100, end)])[-1].met

    assert met(200.0)
    assert not met(300.0)


@pytest.mark.slow
def test_a_short_stream_is_followed_and_measured() -> None:
    samples = memory.follow(40, every=20)
    assert [s.frames for s in samples] == [20, 40]
    assert samples[-1].keyframes > 0


def moving(count: int) -> tuple[list[Item], np.ndarray]:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(0).normal(size=(count, 3))
    image = np.zeros((4, 4, 3), np.uint8)
    return [Item(index=k, timestamp=0.0, image=image, intrinsics=np.ones(4), world_from_cam=p, depth=None)
            for k, p in enumerate(poses)], poses  # fmt: skip


@pytest.mark.parametrize(("registered", "goal"), [(18, "<= 1.2"), (6, "")])
def test_colmap_is_a_mark_only_where_it_registers_most_frames(registered: int, goal: str) -> None:
    items, poses = moving(20)
    theirs, ours = poses[:registered].copy(), poses.copy()
    theirs[0, :3, 3] += 0.1
    ours[0, :3, 3] += 0.05
    ours[3] = np.nan
    none = np.zeros((0, 3), np.uint8)
    model = Model(np.arange(registered), 2.0 * theirs, none, none, {}, 35.0, solving_seconds=30.0)
    nothing = np.zeros(20)
    path = Trajectory(
        np.arange(20), nothing, ours, np.ones(20, bool), nothing.astype(np.uint8), nothing.astype(np.int32)
    )
    rows = baselines.rows("room", Baseline(model, "", (240, 320)), path, items, 3.0)
    assert f"{registered} of 20 frames" in rows[0].unit
    assert rows[1].goal == goal
    assert rows[1].value == pytest.approx(0.5, rel=0.1)
    assert rows[2].value == 10.0
    none = baselines.rows("room", Baseline(None, "no model", (240, 320)), path, items, 3.0)
    assert [r.value for r in none] == ["no model"]


def test_colmaps_model_is_kept_for_the_same_images_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def fake(
        frames: dict[int, np.ndarray], intrinsics: np.ndarray, folder: Path, threads: int, photographs: bool
    ) -> tuple[Model, str]:
        calls.append(len(frames))
        np.savez(folder / "model.npz", index=np.arange(2), world_from_cam=np.zeros((2, 4, 4)), points=0, colors=0)
        (folder / "seconds.json").write_text('{"wall": {"matching": 1.0}, "processor": 2.0, "solving": 1.5}')
        return load(folder), ""

    monkeypatch.setattr(colmap_poses, "reconstruct", fake)
    items, _ = moving(5)
    for used in (items, items, items[:4]):
        baseline = baselines.solve(used, tmp_path, 1, Kept(True))
        assert baseline.model is not None
        assert (baseline.model.processor_seconds, baseline.model.solving_seconds) == (2.0, 1.5)
    assert calls == [5, 4]
    baselines.solve(items[:4], tmp_path, 2, Kept(True))  # more threads take more time of the processor
    baselines.solve(items[:4], tmp_path, 2, Kept(False))
    assert calls == [5, 4, 4, 4]


def test_colmap_is_solved_anew_unless_told_to_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    items, _ = moving(4)
    solved: list[Path] = []

    def reconstruct(frames: dict[int, np.ndarray], intrinsics: np.ndarray, place: Path, *_: object) -> tuple[str, str]:
        solved.append(place)
        (place / "model.npz").touch()
        return "a model", ""

    monkeypatch.setattr(colmap_poses, "reconstruct", reconstruct)
    monkeypatch.setattr(colmap_poses, "load", lambda _: "a model")
    monkeypatch.setattr(Case, "items", lambda _: items)
    commits = []
    for resume in (False, False, True):
        _, origins = baselines.solve_case("room", tmp_path, resume)
        commits.append([origin.commit for origin in origins])
        for file in tmp_path.rglob("*.asked"):
            file.write_text(json.dumps({**json.loads(file.read_text()), "commit": "abc1234"}))
    assert len(solved) == 2
    assert commits[2] == ["abc1234"] != commits[1]


def test_colmap_s_time_is_without_its_start_and_without_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "camera.json").write_text('{"size": [4, 4], "intrinsics": [1, 1, 1, 1]}')
    program = MagicMock()
    model = MagicMock(images={}, points3D={}, cameras={1: MagicMock()})
    model.num_reg_images.return_value = 0
    program.incremental_mapping.return_value = {0: model}
    monkeypatch.setitem(sys.modules, "pycolmap", program)
    monkeypatch.setattr(colmap_poses, "reading_seconds", lambda images: 50.0)  # twice
    colmap_poses.run(tmp_path, 1, photographs=False)
    found = load(tmp_path)
    assert found.processor_seconds > 0.0
    assert found.solving_seconds == pytest.approx(-100.0, abs=0.5)


@pytest.mark.parametrize("errors", [[0.1, math.nan], [math.nan, 0.1]])
def test_a_segment_whose_error_is_not_known_meets_no_goal_and_is_said(errors: list[float]) -> None:
    one = np.array([0, 0, 0, 1])
    path = Trajectory(np.arange(4), 0.1 * one, np.tile(np.eye(4), (4, 1, 1)), one < 1, 0 * one, one)
    result = Result(path, errors, errors, 1.0, {}, 0.0, 0.0, ["2 segments"])
    assert math.isnan(result.worst)
    assert math.isnan(result.worst_of_keyframes)
    plain = {row.name: row for row in rows_of("x", Case("synthetic", goal="1.1"), [result])}
    assert plain["x: ATE keyframes"].met is False
    assert plain["x: segments without a known error"].value == 1
    hard = {row.name: row for row in rows_of("x", Case("synthetic", hard=True), [result])}
    assert hard["x: error over path, 2 segments"].met is False
    known = Result(path, [0.1, 0.2], [0.3, 0.1], 1.0, {}, 0.0, 0.0, [])
    assert (known.worst_of_keyframes, known.worst, known.unknown("x")) == (0.2, 0.3, [])
