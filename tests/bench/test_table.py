"""The command line that every benchmark has: what it refuses, what it leaves, how it ends."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from bench import curves
from bench.table import (
    Origin,
    Row,
    at_least,
    at_most,
    checked,
    failed,
    is_skipped,
    main,
    names,
    numbers,
    origin_of,
    origin_rows,
    skipped,
    timed,
)


def ended(monkeypatch: pytest.MonkeyPatch, rows: list[Row], *words: str) -> int:
    """The exit code of a benchmark that measures these rows."""
    monkeypatch.setattr("sys.argv", ["bench", *words])
    try:
        main(lambda options: rows, "Something")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_rows_go_into_a_folder_that_is_made_and_say_where_they_are_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.table.commit", lambda *_: "abc1234")
    file = tmp_path / "new" / "rows.json"
    assert ended(monkeypatch, [Row("a", 1.0)], "--json", str(file)) == 0
    assert json.loads(file.read_text()) == [
        {"name": "a", "value": 1.0, "unit": "", "goal": "", "met": None, "spread": None}
    ]
    made = json.loads(origin_of(file).read_text())
    assert made["commit"] == "abc1234"
    assert made.keys() == {"commit", "machine", "date"}


def test_a_file_of_what_other_calls_measured_names_their_commit_and_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = Origin.here()
    file = tmp_path / "rows.json"
    before = replace(here, commit="abc1234", date="2026-01-02")
    rows = [*origin_rows("runs", [before], here), Row("before: runs of the commits", "def5678"), Row("a", 1.0)]
    assert [row.name for row in rows[:2]] == ["runs of the commits", "runs of the dates"]
    assert ended(monkeypatch, rows, "--json", str(file)) == 0
    assert json.loads(origin_of(file).read_text()) == asdict(before)
    assert origin_rows("runs", [here, here], here) == origin_rows("runs", [], here) == []


def test_what_is_no_finite_number_is_null_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "rows.json"
    rows = [at_least("psnr", math.nan, "dB", 20.0), timed("time", [1.0, math.nan], "s"), Row("latency", -math.inf)]
    assert ended(monkeypatch, rows, "--json", str(file)) == 0

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    written = json.loads(file.read_text(), parse_constant=refuse)
    assert [(row["name"], row["value"], row["spread"]) for row in written] == [
        ("psnr", None, None), ("time", None, None), ("latency", None, None),
    ]  # fmt: skip
    assert written[0]["met"] is False


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    measured: list[str] = []
    monkeypatch.setattr("sys.argv", ["bench", "--json", str(tmp_path / "file" / "rows.json")])
    with pytest.raises(SystemExit):
        main(lambda options: measured.append("once") or [], "Something")  # type: ignore[func-returns-value]
    assert measured == []
    assert "rows.json: " in capsys.readouterr().err


def test_a_run_that_failed_ends_with_one_and_a_goal_that_is_missed_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ended(monkeypatch, [failed("room", "mapper failed: no memory"), Row("a", 1.0)]) == 1
    assert ended(monkeypatch, [Row("a", 1.0, "", "<= 0.5", False)]) == 0


def test_unknown_names_are_refused_with_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    curves.arguments(parser)
    parser.add_argument("--maps", type=names(["room", "room, loop"], ";"))
    parser.add_argument("--even", type=checked(lambda text: int(text) // 2))
    assert parser.parse_args(["--maps", "room, loop;room"]).maps == ["room, loop", "room"]
    assert parser.parse_args(["--seeds", "5,0"]).seeds == [5, 0]
    for words, told in (
        (["--curves", "mapper.iteration"], "no 'mapper.iteration'; there are: tracker.area, "),
        (["--scenes", "rom"], "no 'rom'; there are: aerial, "),
        (["--seeds", "1,x"], "'1,x' must be numbers such as 0,1,2"),
        (["--maps", "hall"], "no 'hall'; there are: room; room, loop"),
        (["--even", "x"], "invalid literal"),
    ):
        with pytest.raises(SystemExit):
            parser.parse_args(words)
        assert told in capsys.readouterr().err
    assert numbers("3") == [3]


def test_no_number_meets_no_goal() -> None:
    """Whatever place it has among the others: comparisons with NaN are false."""
    for values in ([math.nan, 1.0, 1.2], [1.0, math.nan, 1.2], [1.0, 1.2, math.nan]):
        for goal in ({"maximum": 2.0}, {"minimum": 0.5}):
            row = timed("a", values, "s", **goal)
            assert row.met is False
            assert isinstance(row.value, float)
            assert math.isnan(row.value)


def test_a_goal_that_follows_from_a_run_that_failed_is_met_by_nothing() -> None:
    for value in (1.0, math.inf, math.nan):
        assert at_most("a", value, "s", math.inf).met is False
        assert at_least("a", -value, "s", -math.inf).met is False
        assert at_most("a", value, "s", math.nan).met is False


def test_what_is_left_out_is_said_and_known_again() -> None:
    row = skipped("room", Path("/nowhere"))
    assert (row.name, row.value) == ("room: skipped", "/nowhere is missing")
    assert skipped("room, raft", "no weights").value == "no weights"
    assert is_skipped(row.name)
    assert not is_skipped("room: fraction skipped")
