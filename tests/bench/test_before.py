"""Two checkouts side by side: whose code runs, what is compared with what, which goals are met; pictures of both."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bench import before, finished, pictures, pieces, runs
from bench.runs import CONF, ROOT, Matrix, Run, launch
from bench.table import Row
from mvsgs_core.trajectory import TrackingState


def report(psnr: float, seconds: float = 10.0, keyframes: float | None = None, memory: float = 1e8) -> dict[str, Any]:
    return {
        "rendering": {"held_out": {"psnr": psnr, "ssim": 0.9}, "keyframes": {"psnr": keyframes}},
        "map": {"splats": 100 * seconds, "iterations": 50},
        "time": {"cpu": {"mapper": seconds, "tracker": 2.0, "evaluator": 99.0}},
        "memory": {"peak_bytes": {"mapper": memory, "evaluator": 9e9}},
    }


def some(scene: str, *reports: dict[str, Any] | None) -> list[Run]:
    return [Run(scene, "full", seed, Path("x"), found) for seed, found in enumerate(reports)]


def by_name(rows: list[Row]) -> dict[str, Row]:
    return {row.name: row for row in rows}


def test_changes_are_from_seed_to_seed_with_goals_that_fit_the_scene() -> None:
    old = some("redkitchen", report(30.0, 10.0), report(31.0, 20.0), report(99.0))
    new = some("redkitchen", report(32.0, 11.0), report(34.0, 20.0), None)
    rows = by_name(before.rows_of("redkitchen", old, new))
    change = rows["Held-out frames: redkitchen: PSNR, change"]
    assert (change.value, change.spread, change.goal, change.met) == (2.5, 0.5, ">= 2.5", True)
    assert rows["Held-out frames: redkitchen: PSNR, before"].value == 30.5  # not the seed that failed after
    time = rows["Processor time: redkitchen: mapper, times before"]
    assert time.value == pytest.approx(1.05)
    assert time.met  # 1.1 and 1.0: within its spread
    assert rows["Processor time: redkitchen: all nodes, after"].value == pytest.approx(17.5)
    steady = by_name(before.rows_of("fox", some("fox", report(30.0)), some("fox", report(29.8, 11.0, memory=2e8))))
    assert not steady["Held-out frames: fox: PSNR, change"].met
    assert not steady["Processor time: fox: mapper, times before"].met
    assert not steady["Peak memory: fox: mapper, times before"].met
    assert steady["Held-out frames: fox: PSNR, change"].spread is None
    assert "Held-out frames, by eye: fox: LPIPS, before" not in steady  # no weights, no row


def test_frames_that_are_held_out_in_both_are_compared_by_themselves() -> None:
    old, new = report(25.0), report(26.0)
    for found, psnr in ((old, {5: 20.0, 10: 30.0}), (new, {5: 21.0, 15: 40.0})):
        frames = [{"index": index, "psnr": value, "held_out": True} for index, value in psnr.items()]
        found["rendering"]["frames"] = [*frames, {"index": 3, "psnr": 99.0, "held_out": False}]
    assert before.of_common_frames(old, new) == (20.0, 21.0, 1)
    assert before.of_common_frames(old, report(26.0)) is None
    rows = by_name(before.rows_of("room", some("room", old), some("room", new)))
    change = rows["Frames that are held out in both: room: PSNR, change"]
    assert (change.value, change.met) == (1.0, True)
    assert rows["Frames that are held out in both: room: number"].value == "1"


def test_keyframes_may_be_a_decibel_ahead_of_held_out_frames() -> None:
    rows = by_name(before.rows_of("room", some("room", report(30.0, keyframes=33.0)),
                                  some("room", report(31.0, keyframes=31.5))))  # fmt: skip
    name = "Keyframes: room: PSNR ahead of held-out"
    assert (rows[f"{name}, before"].value, rows[f"{name}, before"].met) == (3.0, None)
    assert (rows[f"{name}, after"].value, rows[f"{name}, after"].met) == (0.5, True)
    far = by_name(before.rows_of("room", some("room", report(30.0, keyframes=30.0)),
                                 some("room", report(30.0, keyframes=31.5))))  # fmt: skip
    assert not far[f"{name}, after"].met


def framed(found: dict[str, Any], *frames: int, psnr: float | None = None) -> dict[str, Any]:
    """With figures of its held-out frames: each as the mean, where nothing else is given."""
    value = found["rendering"]["held_out"]["psnr"] if psnr is None else psnr
    found["rendering"]["frames"] = [{"index": i, "psnr": value, "held_out": True} for i in frames]
    return found


def test_the_cheapest_as_good_as_before_is_what_its_map_costs_now() -> None:
    def seeds(*figures: tuple[float, float]) -> list[Run]:
        return some("room", *(framed(report(*one), 0, 5) for one in figures))

    old = seeds((30.0, 10.0), (30.0, 10.0))
    candidates = {
        "after": seeds((33.0, 10.0), (33.0, 10.0)),
        "10": seeds((30.5, 5.0), (29.7, 3.0)),
        "5": seeds((29.0, 1.0), (30.5, 1.0)),
    }
    rows = by_name(before.at_equal_quality("room", old, candidates))
    assert rows["At before's PSNR: room: cheapest"].value == "10"
    time = rows["At before's PSNR: room: mapper's processor time, times before"]
    assert (time.value, time.met) == (pytest.approx(0.4), True)
    none = before.at_equal_quality("room", old, {"5": candidates["5"]})
    assert [row.met for row in none] == [False]


def test_frames_that_are_not_held_out_in_both_make_no_map_as_good_as_before() -> None:
    old = some("room", framed(report(30.0, 10.0), 0, 5))
    easier = framed(report(35.0, 5.0), 0, psnr=29.0)  # the mean is of other frames, too
    rows = before.at_equal_quality("room", old, {"5": some("room", easier)})
    assert [row.value for row in rows] == ["none is as good"]


def test_the_best_map_in_the_time_of_before_tells_what_is_gained_in_it() -> None:
    def timed(psnr: float, seconds: float) -> list[Run]:
        return some("room", framed(report(psnr, seconds=seconds), 0, 5))

    old = timed(30.0, 10.0)
    candidates = {"30": timed(32.0, 11.0), "20": timed(31.0, 9.0), "10": timed(30.5, 5.0)}
    rows = by_name(before.at_equal_time("room", old, candidates))
    assert rows["At before's processor time: room: best"].value == "20"
    assert rows["At before's processor time: room: mapper's processor time, times before"].value == pytest.approx(0.9)
    gain = rows["At before's processor time: room: PSNR, change"]
    assert (gain.value, gain.met) == (pytest.approx(1.0), True)
    late = before.at_equal_time("room", old, {"30": candidates["30"]})
    assert [row.met for row in late] == [False]


def test_sides_are_checkouts_with_their_iterations() -> None:
    found = before.sides(Path("other"), runs.fewer_iterations("10:100"))
    assert found["before"] == (Path("other"), ())
    assert found["after"] == (ROOT, ())
    assert found["10 a keyframe, 100 at the end"] == (ROOT, ("mapper.iterations=10", "mapper.refinement=100"))


def test_how_long_the_end_is_may_be_left_to_the_mapper() -> None:
    assert runs.fewer_iterations("5:50,22") == {
        "5 a keyframe, 50 at the end": ("mapper.iterations=5", "mapper.refinement=50"),
        "22 a keyframe": ("mapper.iterations=22",),
    }
    for wrong in ("5:", "some", ":50"):
        with pytest.raises(ValueError, match=r"iterations a keyframe.*such as 10:100"):
            runs.fewer_iterations(wrong)


def test_a_checkout_runs_its_own_code_and_its_own_scenes_first(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no checkout of this project: it has no launch/run_all.py"):
        Matrix(["room"], checkout=tmp_path).check()
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "run_all.py").touch()
    (tmp_path / "bench" / "conf").mkdir(parents=True)
    matrix = Matrix(["room"], checkout=tmp_path)
    matrix.check()
    command = matrix.command(tmp_path / "out")
    assert command[0] == sys.executable
    assert str(tmp_path / "launch" / "run_all.py") in command
    assert f"hydra.searchpath=[file://{tmp_path / 'bench' / 'conf'},file://{CONF}]" in command
    own = tmp_path / ".venv" / "bin" / "python"
    own.parent.mkdir(parents=True)
    own.touch()
    assert matrix.command(tmp_path / "out")[0] == str(own)
    assert pieces.asked(matrix) != pieces.asked(Matrix(["room"]))  # --resume takes neither for the other
    assert Matrix(["room"]).command(tmp_path)[0] == sys.executable
    assert runs.environment()["MVSGS_SHARED"]  # the other checkout finds the same data


def test_a_checkout_that_would_run_other_code_is_refused(tmp_path: Path) -> None:
    before.check(ROOT)
    with pytest.raises(ValueError, match=r"would run .*: it needs a .venv of its own"):
        before.check(tmp_path)
    with pytest.raises(ValueError, match="nowhere is no folder"):
        before.checkout_at(str(tmp_path / "nowhere"))


def test_both_run_in_turns_with_the_settings_of_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[tuple[str, Path, tuple[str, ...]]] = []
    other = tmp_path / "other"

    def run(self: Matrix, output: Path) -> list[Run]:
        ran.append((str(output.relative_to(tmp_path)), self.checkout, tuple(self.overrides)))
        (output / "0").mkdir(parents=True)
        (output / "0" / "report.json").write_text(json.dumps(report(30.0 + (self.checkout == ROOT))))
        frames = [{"index": 5, "psnr": 30.0, "held_out": True}]
        kept = {"held_out_fitted": {"psnr": 35.0}, "frames": frames}
        (output / "0" / "scored.json").write_text(json.dumps(kept))  # an earlier call's
        return self.collect(output)

    monkeypatch.setattr(Matrix, "run", run)
    monkeypatch.setattr(Matrix, "check", lambda self: None)
    monkeypatch.setattr(before, "check", lambda checkout: None)
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    before.arguments(parser)
    asked = ["--other", str(other), "--scenes", "redkitchen,room", "--seeds", "0,1", "--output", str(tmp_path),
             "evaluator.lpips=off"]  # fmt: skip
    rows = by_name(before.measure(parser.parse_args(asked)))
    assert [name for name, _, _ in ran] == [
        f"{scene}/{seed}/{side}" for seed in (0, 1) for scene in ("redkitchen", "room") for side in ("before", "after")
    ]
    assert [checkout for _, checkout, _ in ran] == [other, ROOT] * 4
    assert {overrides for name, _, overrides in ran if "redkitchen" in name} == {
        ("dataset.size=[180,240]", "dataset.stop=100", "recorder=track", "mapper.threads=1", "evaluator.lpips=off")
    }
    assert rows["Held-out frames: room: PSNR, change"].value == pytest.approx(1.0)
    assert rows["Held-out frames, camera fitted: room: PSNR, before"].value == 35.0
    assert {"before", "after"} <= rows.keys()


def test_the_window_of_finest_detail() -> None:
    photograph = np.full((40, 80, 3), 100, np.uint8)
    photograph[12:22, 44:64] += (np.indices((10, 20)).sum(axis=0) % 2 * 50).astype(np.uint8)[..., None]
    rows, columns = pictures.finest(photograph)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (10, 20)
    assert abs(rows.start - 12) <= 1
    assert abs(columns.start - 44) <= 1


def test_what_an_earlier_checkout_left_out_of_its_trajectory_is_had_otherwise() -> None:
    track = {
        "index": [0, 5],
        "keyframe": [True, False],
        "segment": [0, 0],
        "world_from_cam": [np.eye(4).tolist(), None],
    }
    frames: dict[int, Any] = {i: argparse.Namespace(timestamp=0.1 * i) for i in (0, 5)}
    told = {"protocol": "The rolling shutter is applied to renders (25.3 ms a frame). ATE: RMSE."}
    found = finished.trajectory_of(track, told, frames)
    assert found.readout_time == pytest.approx(0.0253)
    assert found.timestamp.tolist() == [0.0, 0.5]
    assert found.state.tolist() == [TrackingState.TRACKED, TrackingState.LOST]
    assert found.posed.tolist() == [True, False]
    turned = {"protocol": told["protocol"].replace("a frame", "a frame, the last row first")}
    assert finished.trajectory_of(track, turned, frames).readout_time == pytest.approx(-0.0253)
    upright = {"protocol": told["protocol"].replace("a frame", "a frame, the first column first")}
    found = finished.trajectory_of(track, upright, frames)
    assert (found.readout_time, found.reads_columns) == (pytest.approx(0.0253), True)
    assert finished.trajectory_of(track, {"protocol": "no shutter"}, frames).readout_time == 0.0


@pytest.mark.slow
def test_pictures_of_runs_show_what_their_reports_say(tmp_path: Path) -> None:
    settings = ["dataset.options.scene=room", "dataset.size=[96,128]", "dataset.stop=20", "evaluator.lpips=off"]
    earlier, place = (tmp_path / before.place("room", 0, side) / "0" for side in ("before", "after"))
    launch(
        *settings, f"hydra.searchpath=[file://{CONF}]", "recorder=track", "mapper.iterations=4",
        "mapper.refinement=4", f"output={place}", "inline=true", "screen=plain",
    )  # fmt: skip
    shutil.copytree(place, earlier)
    command = [sys.executable, "-m", "bench.pictures", str(tmp_path), "--scenes", "room", "--to", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, env=runs.environment())
    picture = cv2.imread(str(tmp_path / "before_room.jpg"))
    assert picture is not None
    assert picture.shape == (4 * (180 + pictures.HEADER), 5 * pictures.WIDTH, 3)
    found = finished.FinishedRun(place, finished.frames_of(place))
    file = place / "report.json"
    told = json.loads(file.read_text())
    fitted = told["rendering"].pop("held_out_fitted")
    frames = {f["index"]: f["psnr"] for f in told["rendering"].pop("frames") if f["held_out"]}
    completed = before.completed(Run("room", "full", 0, place, told)).report
    assert completed is not None
    assert completed["rendering"]["held_out_fitted"]["psnr"] == pytest.approx(fitted["psnr"], abs=0.05)
    assert {f["index"]: f["psnr"] for f in completed["rendering"]["frames"]} == pytest.approx(frames, abs=0.01)
    assert found.psnr == pytest.approx(frames, abs=0.01)
    told["rendering"]["held_out"]["psnr"] += 1.0
    file.write_text(json.dumps(told))
    with pytest.raises(ValueError, match="the report says"):
        finished.FinishedRun(place, finished.frames_of(place))
