"""Long benchmarks in pieces: what ended is not run again, what is missing is said; the ablation covers every skip."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from bench import ablation
from bench.pieces import Kept, NotKept, Pieces, with_data
from bench.runs import CONF, Matrix, Run
from bench.table import Row
from nodes.mapper import Mapper
from nodes.mvs import Mvs
from nodes.parameters import parameters


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Folders of the matrices that ran; a run only writes its reports."""
    folders: list[str] = []

    def run(self: Matrix, output: Path) -> list[Run]:
        folders.append(output.name)
        for number, name in enumerate(self.names()):
            (output / str(number)).mkdir(parents=True, exist_ok=True)
            (output / str(number) / "report.json").write_text(json.dumps({"name": name}))
        return self.collect(output)

    monkeypatch.setattr(Matrix, "run", run)
    return folders


def matrices(*names: str, overrides: tuple[str, ...] = ()) -> dict[str, Matrix]:
    return {name: Matrix([name], seeds=[0, 1], overrides=overrides) for name in names}


def test_a_resumed_benchmark_runs_only_what_is_missing(tmp_path: Path, ran: list[str]) -> None:
    first = Pieces(tmp_path).runs(matrices("room"))
    resumed = Pieces(tmp_path, resume=True)
    both = resumed.runs(matrices("room", "fox"))
    assert ran == ["room", "fox"]
    assert [(r.scene, r.seed) for r in both] == [("room", 0), ("room", 1), ("fox", 0), ("fox", 1)]
    assert [r.report for r in both[:2]] == [r.report for r in first]
    assert resumed.rows() == []
    Pieces(tmp_path).runs(matrices("room"))
    assert ran == ["room", "fox", "room"]  # a new measurement is one


def test_a_piece_of_other_settings_or_one_that_was_cut_short_is_not_taken_for_done(
    tmp_path: Path, ran: list[str]
) -> None:
    Pieces(tmp_path).runs(matrices("room"))
    Pieces(tmp_path, resume=True).runs(matrices("room", overrides=("mapper.iterations=3",)))
    assert ran == ["room", "room"]
    (tmp_path / "room" / "piece.json").unlink()
    assert Pieces(tmp_path, resume=True).runs(matrices("room"))
    assert ran == ["room", "room", "room"]


def test_a_piece_with_a_run_that_failed_is_run_again(tmp_path: Path, ran: list[str]) -> None:
    Pieces(tmp_path).runs(matrices("room"))
    file = tmp_path / "room" / "1" / "report.json"

    def fails(matrix: Matrix, output: Path) -> None:
        file.unlink()

    failed = Pieces(tmp_path).runs(matrices("room"), fails)
    assert [run.report is None for run in failed] == [False, True]
    assert not (tmp_path / "room" / "piece.json").exists()
    assert all(run.report for run in Pieces(tmp_path, resume=True).runs(matrices("room")))
    assert ran == ["room", "room"]


def test_a_file_of_other_settings_is_not_taken(tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    asked = {"overrides": ("mapper.iterations=3",), "cores": 2}
    file.touch()
    assert not Kept(True).has(file, asked)  # nobody knows what it is of
    first = Kept(False)
    first.keep(file, asked)
    assert Kept(True).has(file, asked)
    assert not Kept(False).has(file, asked)  # a new measurement is one
    assert not Kept(True).has(file, asked)  # from then on the file is what that call made
    first.keep(file, asked)
    assert not Kept(True).has(file, {**asked, "cores": 1})
    first.keep(file, asked)
    other = Kept(True, replace(first.here, commit="abc1234"))
    assert other.has(file, asked)
    other.keep(tmp_path / "other.json", asked)
    assert [str(row.value) for row in other.origin()] == [f"{first.here.commit}, abc1234"]


def test_runs_that_are_all_of_another_commit_machine_or_day_say_so(tmp_path: Path, ran: list[str]) -> None:
    Pieces(tmp_path).runs(matrices("room"))
    file = tmp_path / "room" / "piece.json"
    made = json.loads(file.read_text())
    for part, value in (("commit", "abc1234"), ("machine", "another"), ("date", "2026-01-02")):
        file.write_text(json.dumps({**made, part: value}))
        found = Pieces(tmp_path, collect=True)
        assert found.runs(matrices("room"))
        assert found.rows() == [Row(f"runs of the {part}s", value)]
    file.write_text(json.dumps({key: value for key, value in made.items() if key not in ("machine", "date")}))
    silent = Pieces(tmp_path, collect=True)
    assert silent.runs(matrices("room"))
    assert [row.value for row in silent.rows()] == ["unknown", "unknown"]
    kept = Kept(False, replace(silent.here, commit="abc1234"))
    (tmp_path / "rows.json").touch()
    kept.keep(tmp_path / "rows.json", 1)
    later = Kept(True)
    assert later.has(tmp_path / "rows.json", 1)
    assert later.origin() == [Row("results of the commits", "abc1234")]
    assert ran == ["room"]


def test_runs_that_went_beside_each_other_are_not_taken_for_runs_alone(tmp_path: Path, ran: list[str]) -> None:
    """Their times are others."""
    for jobs in (2, 1, 2, 2):
        Pieces(tmp_path, resume=True).runs({"room": Matrix(["room"], jobs=jobs)})
    assert ran == ["room", "room", "room"]


def test_where_runs_are_only_read_a_file_that_is_missing_is_not_measured(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    file.touch()
    Kept(False).keep(file, 1)
    pieces = Pieces(tmp_path, collect=True)
    kept = pieces.kept()
    assert kept.has(file, 1)
    with pytest.raises(NotKept, match=r"rows\.json is not measured yet"):
        kept.has(file, 2)
    assert kept.has(file, 1)
    assert len(pieces.origins) == 2  # one table, one statement


def test_scenes_whose_data_are_missing_are_left_out_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_SHARED", "/nowhere")
    scenes, rows = with_data(["room", "redkitchen"])
    assert scenes == ["room"]
    assert rows == [Row("redkitchen: skipped", "/nowhere/data/seven_scenes_redkitchen is missing")]


def test_what_did_not_run_and_other_commits_are_said(tmp_path: Path, ran: list[str]) -> None:
    Pieces(tmp_path).runs(matrices("room"))
    file = tmp_path / "room" / "piece.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "commit": "abc1234"}))
    Pieces(tmp_path).runs(matrices("fox"))
    late = Pieces(tmp_path, resume=True, minutes=0.0)
    found = late.runs(matrices("room", "fox", "fountain"))
    assert {r.scene for r in found} == {"room", "fox"}
    assert late.missing == ["fountain"]
    said = {row.name: str(row.value) for row in late.rows()}
    assert said["runs of the commits"].startswith("abc1234, ")
    assert said["not run yet (--resume goes on with them)"] == "fountain"
    assert Pieces(tmp_path, collect=True).runs(matrices("fountain")) == []
    assert "fountain" not in ran


def test_the_ablation_switches_everything_that_can_be_skipped() -> None:
    def keys(name: str) -> set[str]:
        config = OmegaConf.to_container(OmegaConf.load(CONF / "variant" / f"{name}.yaml"))
        assert isinstance(config, dict)
        chosen = [key for choice in config.pop("defaults", []) if isinstance(choice, dict) for key in choice]
        return set(paths(config)) | {k.split("/")[-1] for k in chosen}

    def paths(values: Any, where: str = "") -> Iterator[str]:
        for key, value in values.items():
            if isinstance(value, dict):
                yield from paths(value, f"{where}{key}.")
            else:
                yield f"{where}{key}"

    switched = set().union(*(keys(name) for name in ablation.TABLE_III + ablation.SKIPS + ablation.OTHERS))
    switches = {p.path for p in parameters(Mapper.Config, "mapper") if isinstance(p.default, bool)}
    switches -= {"mapper.keep_map", "mapper.save_images"}  # what is written beside the map
    switches -= {"mapper.training.antialiased"}  # for maps seen from afar, which no scene here scores
    stereo = [parameter for parameter in parameters(Mvs.Config, "mvs") if isinstance(parameter.default, bool)]
    switches |= {parameter.path for parameter in stereo if parameter.path.startswith("mvs.pruning.")}
    switches -= {"mvs.pruning.outside_range"}  # what it leaves out cannot be chosen
    assert {"mapper.convergence.skip", "mvs.pruning.outside_cells"} <= switches
    assert switches <= switched
    others = {f"mapper.insertion.{name}" for name in ("price", "median_errors")}
    others |= {f"mapper.{name}" for name in ("density_control.mode", "training.kernel", "training.loss", "sh_degree")}
    assert others <= switched
    assert {
        "mvs",
        "depth_fusion",
        "tracker",
        "tracker.front_end.still_flow",
        "tracker.readout_time",
        "tracker.frames_between",
    } <= switched


def test_a_partial_ablation_shows_the_variants_it_has(tmp_path: Path) -> None:
    runs = [Run("room", variant, seed, tmp_path, {"rendering": {"held_out": {"psnr": 20.0 + seed}}})
            for variant in ("full", "A") for seed in (0, 1)]  # fmt: skip
    rows = ablation.rows_of(runs, ["room", "fox"], ["A", "B"])
    assert [row.name for row in rows] == ["room: full: held-out PSNR", "room: A: held-out PSNR, change"]
