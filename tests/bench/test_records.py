"""Records of benchmarks, their place in BENCHMARKS.md, and the comparison with the recorded line."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from bench import compare, curves, figures, pivot, record
from bench.runs import choices
from bench.table import Row, origin_of, timed


@pytest.fixture(autouse=True)
def _from_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of rows without an origin of their own, which tests write, are of one commit."""
    monkeypatch.setattr(record, "commit", lambda: "abc1234")


def measured_at(file: Path, commit: str, date: str = "2026-01-02") -> None:
    origin_of(file).write_text(json.dumps({"commit": commit, "machine": "a machine", "date": date}))


def row(name: str, value: Any, unit: str = "", goal: str = "", met: bool | None = None) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "goal": goal, "met": met}


def test_repeated_runs_are_merged_with_their_spread() -> None:
    merged = record.merge([
        [row("a", 1.0, "s", "<= 2", True), row("only", "word")], [row("a", 2.0, "s", "<= 2", True)],
        [row("a", 3.0, "s", "<= 2", False)],
    ])  # fmt: skip
    assert merged[0]["value"] == 2.0
    assert merged[0]["spread"] == 1.0
    assert merged[0]["met"] is False
    assert merged[1] == {**row("only", "word"), "spread": None}


def test_two_rows_of_one_name_in_one_run_are_not_taken_for_two_runs() -> None:
    with pytest.raises(ValueError, match="several rows of one name: a"):
        record.merge([[row("a", 1.0), row("b", 1.0), row("a", 2.0)]])
    skipped = row("redkitchen: skipped", "no data")
    assert len(record.merge([[skipped, skipped]])) == 1  # by two sections: no figure


def test_a_figure_that_one_of_the_runs_lacks_is_none(tmp_path: Path) -> None:
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    files[0].write_text('[{"name": "psnr", "value": null, "met": false}, {"name": "time", "value": NaN}]')
    files[1].write_text('[{"name": "psnr", "value": 30.5, "met": true}, {"name": "time", "value": Infinity}]')
    merged = record.merge(record.read_rows(files))
    assert [(row["value"], row["spread"], row["met"]) for row in merged] == [(None, None, False), (None, None, None)]


def test_a_timed_figure_is_a_median_with_its_spread_and_meets_its_goal_where_all_of_it_does() -> None:
    within, beyond = (timed("ratio", values, "x", maximum=1.5) for values in ([1.2, 1.0, 1.4], [1.2, 1.0, 1.6]))
    assert (within.value, within.spread, within.met) == (1.2, pytest.approx(0.2), True)
    assert (beyond.value, beyond.met) == (1.2, False)  # the median alone would
    assert within.goal == "<= 1.5, all of 3"
    assert timed("speed", [3.9, 5.0, 6.0], "x", minimum=4.0).met is False
    assert timed("speed", [4.1, 5.0, 6.0], "x", minimum=4.0).met is True
    assert timed("time", [2.0, 1.0], "s") == Row("time", 1.5, "s", spread=0.5)
    kept = record.merge([[asdict(beyond)]])
    assert kept[0]["spread"] == pytest.approx(0.3)
    both = record.merge([[asdict(within)], [asdict(beyond)]])
    assert both[0]["value"] == 1.2
    assert both[0]["spread"] == pytest.approx(0.3)  # of the runs, and within them
    assert both[0]["met"] is False


def test_records_are_rendered_between_their_markers_only(tmp_path: Path) -> None:
    files = []
    for k, value in enumerate((1.0, 2.0)):
        files.append(tmp_path / f"{k}.json")
        files[-1].write_text(json.dumps([row("latency | 99 %", value, "ms", "<= 3", True)]))
        measured_at(files[-1], "abc1234")
    made = record.record("quick/transport", files, "python -m bench.transport", folder=tmp_path)
    assert record.Record.load("quick/transport", tmp_path) == made
    block = "<!-- bench:{0} -->\n{1}<!-- /bench:{0} -->\n"
    text = "before\n" + block.format("quick/transport", "old\n") + "after\n" + block.format("x", "")
    once = record.render(text, tmp_path)
    assert once.startswith("before\n<!-- bench:quick/transport -->\n\nRecorded 2")
    assert ". 2 runs. Command:\n\n```\npython -m bench.transport\n```\n" in once.replace(",\n", ", ")
    assert "| latency \\| 99 % | 1.5 ± 0.5 ms | &lt;= 3 |" in once
    assert "old" not in once
    assert "\nafter\n" in once
    assert "Not recorded yet" in once
    assert record.render(once, tmp_path) == once


def test_figures_that_subjects_share_stand_side_by_side() -> None:
    rows = [row(f"{s}: error", 1.0 + k, "cm", "<= 2", k < 2) for k, s in enumerate(("room", "desk", "loop"))]
    rows += [row(f"{s}: keyframes", 20 + k, f"of {100 + k}") for k, s in enumerate(("room", "desk", "loop"))]
    rows += [row("loop: closed", "yes"), row("all: seconds", 3.0, "s", "<= 4", True)]
    text = pivot.markdown(rows)
    assert "|  | error, cm (goal &lt;= 2) | keyframes |" in text
    assert "| room | 1 | 20 of 100 |" in text
    assert "| loop | **3** | 22 of 102 |" in text
    assert "| loop: closed | yes |  |" in text
    assert "| all: seconds | 3 s | &lt;= 4 |" in text
    assert text.endswith("Bold: misses its goal.")


def test_a_table_has_fewer_columns_than_lines_and_every_row_once() -> None:
    rows = [row(f"{s}: f{k}", k) for s in "abc" for k in range(5)] + [
        row(f"{s}: g{k}", k) for s in "def" for k in (0, 1)
    ]
    text = pivot.markdown(rows)
    assert "|  | a | b | c |" in text
    assert "| f4 | 4 | 4 | 4 |" in text
    assert "|  | g0 | g1 |" in text
    assert text.count("|") == 5 * 7 + 4 * 5


def test_groups_have_tables_of_their_own_and_wide_ones_are_cut() -> None:
    rows = [row(f"{g}: {s}: f{k}", k) for g in ("one", "two") for s in "abcdefghij" for k in range(9)]
    text = pivot.markdown(rows)
    assert text.count("**one**") == text.count("**two**") == 1
    assert text.count("|  | f0 | f1 | f2 | f3 | f4 |") == text.count("|  | f5 | f6 | f7 | f8 |") == 2
    sparse = pivot.markdown([*(r for r in rows[:90] if r["name"] < "one: j: f5")])
    assert sparse.count("| j |") == 1  # not in the second, where it has nothing


def test_what_has_no_room_in_a_cell_is_told_below() -> None:
    text = pivot.markdown([row("room: error", 1.0), row("room: it said", "word " * 60)])
    assert text.startswith("|  | value |")
    below = text.partition("\n- room: it said: ")[2].splitlines()
    assert len(below) > 2
    assert max(map(len, below)) <= pivot.WIDTH
    assert "said" not in text.partition("\n- ")[0]


def test_a_record_has_a_row_a_line_and_comes_back_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "rows.json").write_text(json.dumps([row("a", 1.0), row("b", "word", "x", "<= 2", True)]))
    measured_at(tmp_path / "rows.json", "abc1234")
    made = record.record("curves", [tmp_path / "rows.json"], "c", note="on a Sunday", folder=tmp_path)
    lines = (tmp_path / "curves.json").read_text().splitlines()
    assert '{"name": "a", "value": 1.0},' in lines
    assert '{"name": "b", "value": "word", "unit": "x", "goal": "<= 2", "met": true}' in lines
    assert record.Record.load("curves", tmp_path) == made
    assert "Made so: on a Sunday." in made.markdown()


def test_a_record_says_where_and_when_it_was_measured_not_recorded(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("one.json", "two.json", "old.json")]
    for file in files:
        file.write_text(json.dumps([row("a", 1.0)]))
    measured_at(files[0], "1111111")
    measured_at(files[1], "2222222", "2026-01-03")
    made = record.record("curves", files[:2], "c", folder=tmp_path)
    assert (made.commit, made.machine, made.date) == ("1111111, 2222222", "a machine", "2026-01-02, 2026-01-03")
    assert made.note == ""
    silent = record.record("curves", files, "c", note="on a Sunday", folder=tmp_path)
    assert silent.commit == "1111111, 2222222, abc1234"
    assert silent.note == "on a Sunday; commit, machine and date are those of recording old.json"


def test_rows_that_the_documents_cannot_be_made_of_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A record is replaced as a whole: what a run without its data leaves would wipe it."""
    saved: list[str] = []
    monkeypatch.setattr(record, "keep", lambda entry, *args: saved.append(entry.name))
    file = tmp_path / "rows.json"
    file.write_text(json.dumps([row("redkitchen: ours", "failed", "", "a report", False)]))
    assert record.run(["baselines", str(file)]) == 1
    assert "these rows lack redkitchen: map, COLMAP + splatting" in capsys.readouterr().out
    file.write_text(json.dumps([row("redkitchen: skipped", "no data")]))
    assert record.run(["baselines", str(file)]) == 0
    assert "measured nothing" in capsys.readouterr().out
    unplotted = "redkitchen: map, COLMAP + splatting, 2 times as long: seconds, frames to map"
    file.write_text(json.dumps([r for r in record.Record.load("baselines").rows if r["name"] != unplotted]))
    assert record.run(["baselines", str(file)]) == 1
    assert "'seconds, frames to map'" in capsys.readouterr().out
    assert saved == []


def test_plots_of_a_run_go_beside_the_page(tmp_path: Path) -> None:
    run, pages = tmp_path / "run", tmp_path / "pages"
    run.mkdir()
    (run / "room.svg").write_text("<svg/>")
    (tmp_path / "rows.json").write_text(json.dumps([row("a", 1.0)]))
    made = record.record("curves", [tmp_path / "rows.json"], "c", run, folder=tmp_path / "kept", pages=pages)
    assert "![curves room](curves_room.svg)" in made.markdown()
    assert (pages / "curves_room.svg").read_text() == "<svg/>"


def test_the_figures_name_rows_that_are_recorded_and_benchmarks_that_print_them() -> None:
    text = figures.markdown(lambda name: record.Record.load(name).rows)
    assert len(text.splitlines()) == 2 + len(figures.FIGURES) == 12
    of_colmap = [line for line in text.splitlines() if "COLMAP" in line]
    protocol = {r["name"]: r["value"] for r in record.Record.load("baselines").rows}["redkitchen: protocol"]
    assert "at 240x180" in protocol
    assert "COLMAP got 100 of the frames at 512x384" in protocol
    assert all("100 frames at 240x180" in line and " at 512x384" in line for line in of_colmap)
    assert sum(line.startswith("| Processor time ") for line in of_colmap) == 2
    kept = {"name": "room, 320x240: completeness", "value": 0.5}
    changed = figures.markdown(lambda name: [*record.Record.load(name).rows, kept])
    assert "kept pixels within 2 %, at 0.50 of completeness" in changed
    with pytest.raises(KeyError, match="ATE"):
        figures.markdown(lambda name: [row("other", 1.0)])
    for name in {figure.benchmark for figure in figures.FIGURES}:
        assert figures.lacking(name, record.Record.load(name).rows) == []
        assert figures.lacking(name, [])
    assert figures.lacking("curves", []) == []
    drawn = figures.plots_of(lambda name: record.Record.load(name).rows)
    assert drawn["poses"].count("<rect") >= 10
    assert drawn["maps"].count("<circle") >= 6


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        (row("psnr", 25.0, "dB"), row("psnr", 24.8, "dB"), None),  # noise
        (row("psnr", 25.0, "dB"), row("psnr", 24.5, "dB"), "worse"),
        (row("psnr", 25.0, "dB"), row("psnr", 23.5, "dB"), "regression"),
        (row("psnr", 25.0, "dB"), row("psnr", 26.0, "dB"), "better"),
        (row("psnr", 25.0, "dB"), row("psnr", float("nan"), "dB"), "regression"),
        (row("latency", 10.0, "ms"), row("latency", 13.0, "ms"), None),
        (row("latency", 10.0, "ms"), row("latency", 30.0, "ms"), "regression"),
        (row("front end", 10.0, "ms/frame CPU", "<= 40", True), row("front end", 13.0, "ms/frame CPU"), None),
        (row("processor", 1.0, "s a keyframe"), row("processor", 3.0, "s a keyframe"), "regression"),
        (row("delay", 10.0, "ms, median"), row("delay", 30.0, "ms, median"), "regression"),
        (row("throughput", 1000.0, "MB/s"), row("throughput", 300.0, "MB/s"), "regression"),
        (row("room/full: ATE %", 0.4, "% of the path"), row("room/full: ATE %", 0.5, "% of the path"), None),
        (row("room/full: ATE %", 0.4, "% of the path"), row("room/full: ATE %", 2.0, "% of the path"), "regression"),
        (row("depth inliers", 0.9), row("depth inliers", 0.7), "regression"),
        (row("ratio", 1.0, "x", "<= 2", True), row("ratio", 1.3, "x", "<= 2", True), None),
        (row("ratio", 1.0, "x", "<= 2", True), row("ratio", 3.0, "x", "<= 2", False), "regression"),
        (row("speedup", 5.0, "x", ">= 4", True), row("speedup", 3.0, "x", ">= 4", False), "regression"),
        (row("speedup", 4.1, "x", ">= 4", True), row("speedup", 3.9, "x", ">= 4", False), None),  # noise
        (row("speedup", 5.0, "x"), row("speedup", 3.0, "x"), None),  # without a goal
        (row("psnr", 25.0, "dB"), row("psnr", None, "dB"), "regression"),
        (row("psnr", 25.0, "dB"), row("psnr", "failed", "dB"), "regression"),
        (row("splats", 1000), row("splats", None), "regression"),
        (row("psnr", None, "dB"), row("psnr", None, "dB"), None),
        (row("none is sent", True, "", "True", True), row("none is sent", False, "", "True", False), "regression"),
        (row("keyframes", 12, "", "12", True), row("keyframes", 11, "", "12", False), "regression"),
        (row("latency", float("inf"), "ms"), row("latency", 10.0, "ms"), "better"),
        (row("latency", float("inf"), "ms"), row("latency", float("inf"), "ms"), None),
        (row("latency", 10.0, "ms"), row("latency", float("inf"), "ms"), "regression"),
        (
            row("its outliers over ours", 3.0, "", ">= 2"),
            row("its outliers over ours", 9.0, "", ">= 2"),
            "better",
        ),
        (
            row("its outliers over ours", 3.0, "", ">= 2"),
            row("its outliers over ours", 1.0, "", ">= 2"),
            "regression",
        ),
        (row("outliers of kept", 0.01, "", "<= 0.05"), row("outliers of kept", 0.2, "", "<= 0.05"), "regression"),
        (row("PSNR lost", 0.1, "dB", "<= 0.3"), row("PSNR lost", 1.5, "dB", "<= 0.3"), "regression"),
        (row("room: LPIPS", 0.2), row("room: LPIPS", 0.1), "better"),
        (row("bare walls: kept", 0.2), row("bare walls: kept", 0.9), None),  # no wall time
        (row("splats", 1000), row("splats", 5000), None),  # neither is better
        (row("map finite", "all", "", "finite", True), row("map finite", "NaN", "", "finite", False), "regression"),
    ],
)
def test_comparison_tells_noise_from_regressions(
    before: dict[str, Any], now: dict[str, Any], expected: str | None
) -> None:
    found = compare.change(now, before, same_machine=True)
    if expected is None:
        assert found is None
    else:
        assert found is not None
        assert ("regression" if found.regression else "worse" if found.worse else "better") == expected


def test_times_of_another_machine_warn_only_and_the_recorded_spread_counts() -> None:
    slow = compare.change(row("latency", 90.0, "ms"), row("latency", 10.0, "ms"), same_machine=False)
    assert slow is not None
    assert slow.worse
    assert not slow.regression
    for unit in ("ms/frame CPU", "ms/keyframe CPU", "s CPU", "ms/image", "MB", "MB, jpeg"):
        goal = unit, "<= 500", True
        found = compare.change(row("cost", 400.0, *goal), row("cost", 100.0, *goal), same_machine=False)
        assert found is not None, unit
        assert (found.worse, found.regression) == (True, False), unit
    assert compare.change(row("psnr", 24.0, "dB"), {**row("psnr", 25.0, "dB"), "spread": 0.5}, True) is None


def test_compare_exits_with_one_for_regressions_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line, now = tmp_path / "line", tmp_path / "mapping.json"
    now.write_text(json.dumps([row("psnr", 25.0, "dB"), row("other", 1.0)]))
    record.record("mapping", [now], "c", folder=line)
    assert compare.run([str(now), "--recorded", str(line)]) == 0
    now.write_text(json.dumps([row("psnr", 20.0, "dB")]))
    assert compare.run([str(now), "--recorded", str(line)]) == 1
    printed = capsys.readouterr().out
    assert "REGRESSION  psnr: 25 dB -> 20 dB" in printed
    assert "the row is missing" in printed
    assert compare.run([str(now), "--recorded", str(tmp_path / "empty")]) == 0


@pytest.mark.parametrize(
    ("benchmark", "skipped", "gone"),
    [
        ("learned", ["fr1_xyz, itermvs", "fr1_xyz, raft_small"], "fr1_xyz"),
        ("tracking", ["tum_fr1_xyz"], "tum_fr1_xyz"),
        ("networks", ["IterMVS, 5 views"], "IterMVS"),
        ("ros2", ["message types whose bytes equal rosbags'", "640x480", "publisher"], ""),
        ("depth", ["cost kernel"], "cost kernel"),
    ],
)
def test_what_is_skipped_is_not_compared(benchmark: str, skipped: list[str], gone: str) -> None:
    recorded = record.Record.load(f"quick/{benchmark}")
    rows = [r for r in recorded.rows if not r["name"].startswith(gone)]
    assert len(rows) < len(recorded.rows)
    assert any(c.regression for c in compare.compare(benchmark, rows, recorded))
    assert compare.compare(benchmark, rows + [row(f"{name}: skipped", "no data") for name in skipped], recorded) == []
    if rows:
        rest = [row(f"{name}: skipped", "no data") for name in skipped]
        assert any(c.regression for c in compare.compare(benchmark, rest, recorded))


def test_compare_says_what_it_does_not_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line, now = tmp_path / "line", tmp_path / "tracking.json"
    now.write_text(json.dumps([row("walk: keyframes", 25.0)]))
    record.record("tracking", [now], "c", folder=line)
    now.write_text(json.dumps([row("walk: skipped", "/data/walk is missing")]))
    assert compare.run([str(now), "--recorded", str(line)]) == 0
    assert "  not compared: walk: skipped: /data/walk is missing" in capsys.readouterr().out


def test_what_is_recorded_of_variants_and_curves_can_be_run() -> None:
    variants = {row["name"].split(": ")[1] for row in record.Record.load("ablation").rows}
    assert variants - {"full"} <= set(choices("variant"))
    known = {f"{curve} {label}" for curve, points in curves.CURVES.items() for label in points}
    assert {row["name"].split(": ")[1] for row in record.Record.load("curves").rows} - {"default"} <= known
