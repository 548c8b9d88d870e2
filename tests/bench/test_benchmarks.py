"""The benchmarks' own logic on small figures, and that all scenes and variants compose."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import ablation, curves, memory, plots, scenes
from bench.runs import CONF, Matrix, Run, Setting, choices, figure, said
from bench.stress import __main__ as stress
from bench.table import Row, at_least, at_most
from launch.compose import compose
from launch.refusal import GraphError
from tests.support.benchmarks import BENCHMARKS
from tests.support.shared_data import ROOT

SEARCH = f"hydra.searchpath=[file://{CONF}]"


def report(psnr: float = 25.0, wall: float = 10.0, **more: Any) -> dict[str, Any]:
    return {
        "rendering": {"held_out": {"psnr": psnr, "ssim": 0.8}},
        "trajectory": {"ate_percent": 0.5, "frames": 100, "frames_tracked": 100, "keyframes": 20, "segments": 1},
        "depth": {"inlier_ratio": 0.9, "completeness": 0.6},
        "map": {"splats": 1000, "bytes": 2_000_000},
        "time": {"wall": wall, "stages": {"mapper": {"insertion": 1.0, "optimization": 2.0}}},
        "memory": {"peak_bytes": {"mapper": 3e8, "tracker": 1e8}},
        "warnings": {},
        **more,
    }


def a_run(scene: str = "room", variant: str = "full", seed: int = 0, **figures: Any) -> Run:
    return Run(scene, variant, seed, Path("nowhere"), report(**figures), figures.get("setting", ""))


def test_rows_know_whether_they_meet_their_goal() -> None:
    assert at_most("a", 2.0, "s", 2.0).met
    assert not at_most("a", 2.1, "s", 2.0).met
    assert at_least("a", 2.0, "s", 2.0).met
    assert at_least("a", 1.9, "s", 2.0) == Row("a", 1.9, "s", ">= 2", False)


@pytest.mark.slow
@pytest.mark.parametrize("names", [choices("scene")[k::4] for k in range(4)])
def test_every_scene_composes(names: Sequence[str]) -> None:
    for name in names:
        graph = compose([SEARCH, f"+scene={name}"])
        assert "dataset" in graph.sources, name


@pytest.mark.slow
@pytest.mark.parametrize("names", [choices("variant")[k::4] for k in range(4)])
def test_every_variant_composes_and_changes_something_or_is_the_full_system(names: Sequence[str]) -> None:
    plain = compose([SEARCH, "+scene=room", "output=same"]).resolved
    for name in names:
        graph = compose([SEARCH, "+scene=room", f"+variant={name}", "output=same"])
        assert (graph.resolved == plain) == (name == "full"), name


@pytest.mark.slow
def test_variants_and_curves_name_what_there_is(tmp_path: Path) -> None:
    assert set(ablation.TABLE_III + ablation.SKIPS + ablation.OTHERS) <= set(choices("variant"))
    assert {*ablation.SCENES, *stress.REAL} <= set(choices("scene"))
    drawn = [setting for curve in curves.settings(curves.CURVES).values() for setting in curve]
    given = drawn + [stress.setting(n, s) for n, w in stress.DIFFICULTIES.items() for s in w]
    matrix = Matrix(["room"], settings=given)
    matrix.check()
    matrix.write_settings(tmp_path)
    plain = compose([SEARCH, "+scene=room", "output=same"]).resolved
    search = f"hydra.searchpath=[file://{CONF},file://{tmp_path}/settings]"
    for setting in given[:: max(1, len(given) // 16)] + [s for s in given if "stages" in s.name]:
        graph = compose([search, "+scene=room", f"+setting={setting.name}", "output=same"])
        assert (graph.resolved == plain) == (not setting.overrides), setting.name


def test_settings_override_choices_and_parameters(tmp_path: Path) -> None:
    setting = Setting("coarse", ("mvs=coarse", "mapper.iterations=7", "mapper.max_pixels=9600"))
    matrix = Matrix(
        ["room"], overrides=["mvs=plane_sweep", "mapper.iterations=3", "evaluator.lpips=off"], settings=[setting]
    )
    matrix.write_settings(tmp_path)
    assert "mapper.iterations=3" not in matrix.command(tmp_path)
    graph = compose([f"hydra.searchpath=[file://{CONF},file://{tmp_path}/settings]", "+scene=room", "+setting=coarse"])
    assert graph.slots["mvs"].target == "nodes.coarse_depth.CoarseDepth"
    assert graph.slots["mapper"].config["iterations"] == 7
    assert graph.slots["mapper"].config["max_pixels"] == 9600
    assert graph.slots["evaluator"].config["lpips"] == "off"
    with pytest.raises(ValueError, match="slot=choice"):
        Setting("bad", ("mapper",)).text()


def test_a_slow_node_and_the_track_recorder_stand_in_the_graph() -> None:
    graph = compose([SEARCH, "+scene=room", "depth_fusion._target_=bench.live.slow.SlowFusion"])
    assert graph.slots["depth_fusion"].config["factor"] == 10.0
    with pytest.raises(GraphError, match="recorder has no choice"):
        compose(["recorder=track"])
    graph = compose([SEARCH, "+scene=room", "++recorder._target_=bench.tracking.recorder.TrackRecorder",
                     "++recorder.reads.Trajectory=tracker"])  # fmt: skip
    assert any(edge.reader == "recorder" for edge in graph.edges)


def test_the_command_names_everything_and_jobs_are_in_its_order(tmp_path: Path) -> None:
    matrix = Matrix(["room", "fox"], ["full", "A"], [0, 3], (), 2, [Setting("x"), Setting("y")])
    command = matrix.command(tmp_path)
    for text in ("-m", "+scene=room,fox", "+variant=full,A", "+setting=x,y", "seed=0,3"):
        assert text in command
    assert "hydra/launcher=joblib" in command
    assert "mapper.iterations=2" in Matrix(["room"], overrides=["mapper.iterations=2"]).command(tmp_path)
    for number, name in enumerate(matrix.names()):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "report.json").write_text(json.dumps({"name": name}))
    runs = matrix.collect(tmp_path)
    assert [(r.scene, r.variant, r.setting, r.seed) for r in runs] == [tuple(r.report["name"]) for r in runs]  # type: ignore[index]
    assert len(runs) == 16
    assert (runs[1].scene, runs[1].variant, runs[1].setting, runs[1].seed) == ("room", "full", "x", 3)
    (tmp_path / "0" / "report.json").write_text(json.dumps({"finished": False, "reason": "mapper failed"}))
    assert matrix.collect(tmp_path)[0].report is None  # it ended early: no result


def test_unknown_names_are_refused_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"no scene rom; there are: .*room"):
        Matrix(["rom"]).check()
    with pytest.raises(ValueError, match=r"no variant Z; there are: A, B"):
        Matrix(["room"], ["Z"]).check()
    with pytest.raises(ValueError, match="two settings of one name"):
        Matrix(["room"], settings=[Setting("a"), Setting("a")]).check()


def test_figures_of_a_report() -> None:
    assert figure(report(), "rendering.held_out.psnr") == 25.0
    assert figure(report(), "rendering.nothing.psnr") is None
    assert figure(None, "time.wall") is None


def test_what_a_run_said(tmp_path: Path) -> None:
    assert said(a_run()) == "nothing"
    lost = Run("room", "full", 0, tmp_path / "0", report(warnings={"tracker": ["lost"], "mvs": ["no depth"]}))
    assert said(lost) == "tracker: lost; mvs: no depth"
    log = "job 0\ntracker failed: ValueError: no image\nlog: {0}/0/logs/tracker.log\n"
    log += "job 1\nmapper failed: MemoryError\nlog: {0}/1/logs/mapper.log\n"
    (tmp_path / "runs.log").write_text(log.format(tmp_path))
    assert said(Run("room", "full", 0, tmp_path / "0", None)) == "tracker failed: ValueError: no image"
    log = "job 0: scene=room\nerror: dataset: no such file\nerror: job 0 ended with code 2\n"
    log += "job 1: scene=fox\nerror: mapper: no such choice\nerror: job 1 ended with code 2\n"
    (tmp_path / "runs.log").write_text(log)
    for number, cause in (("0", "error: dataset: no such file"), ("1", "error: mapper: no such choice")):
        assert said(Run("room", "full", 0, tmp_path / number, None)) == cause  # not what follows from it


def test_scene_rows_are_means_with_spreads_the_papers_and_failures() -> None:
    runs = [a_run(seed=0, psnr=24.0), a_run(seed=1, psnr=26.0), a_run("tum_desk"), Run("fox", "A", 0, Path("x"), None)]
    found = {row.name: row for row in scenes.rows(runs)}
    assert found["room/full: held-out PSNR"] == Row("room/full: held-out PSNR", 25.0, "dB", spread=1.0)
    assert found["tum_desk/full: held-out PSNR"].spread is None
    assert found["tum_desk/the paper: all PSNR"].value == 20.67
    assert found["fox/A/seed 0: finished"].met is False
    assert scenes.time_against_error(runs[:3]).startswith("<svg")


def test_ablation_says_sign_size_and_what_is_within_the_spread() -> None:
    runs = [a_run(variant=v, seed=s, psnr=p + 0.1 * s) for v, p in (("full", 25.0), ("A", 22.0), ("B", 25.05))
            for s in range(3)]  # fmt: skip
    found = ablation.difference(ablation.select(runs, "room", "A"), runs[:3], "rendering.held_out.psnr")
    assert found is not None
    assert found.real
    assert found.mean == pytest.approx(-3.0)
    assert found.spread == pytest.approx(0.1)
    rows = {row.name: row for row in ablation.rows_of(runs, ["room"], ["A", "B"])}
    assert rows["room: full: held-out PSNR"].spread == pytest.approx(0.1)
    assert rows["room: A: held-out PSNR, change"].value == "-3.00 ± 0.10"
    assert rows["room: B: held-out PSNR, change"].value == "~ +0.05 ± 0.10"


def test_an_ablation_of_one_run_calls_nothing_real() -> None:
    runs = [a_run(variant="full", psnr=25.0), a_run(variant="A", psnr=22.0)]
    found = ablation.difference(runs[1:], runs[:1], "rendering.held_out.psnr")
    assert found is not None
    assert not found.real
    rows = {row.name: row for row in ablation.rows_of(runs, ["room"], ["A"])}
    assert rows["room: full: held-out PSNR"].spread is None
    assert rows["room: A: held-out PSNR, change"].value == "once: -3.00"


def test_pareto_front_and_its_plot(tmp_path: Path) -> None:
    assert plots.pareto([3.0, 1.0, 2.0, 4.0, np.nan], [9.0, 1.0, 0.5, 9.0, 99.0]) == [1, 0]
    svg = plots.front_plot([("area", "a & b", 1.0, 2.0), ("area", "c", 2.0, 3.0)], (2.0, 3.0), "s", "dB", (0.1, 0.1))
    plots.write(tmp_path / "plot.svg", svg)
    text = (tmp_path / "plot.svg").read_text()
    assert text.count("xmlns=") == 1
    assert "a &amp; b" in text
    assert "stroke-dasharray" in text
    assert "noise (box)" in text


def test_curves_average_seeds_and_mark_the_front() -> None:
    chosen = {"mapper.iterations": {"15": "15", "90": "90"}}
    names = [setting.name for settings in curves.settings(chosen).values() for setting in settings]
    assert names == ["default", "mapper_iterations_15", "mapper_iterations_90"]
    runs = [
        Run("room", "full", s, Path("x"), report(p, w), n)
        for n, p, w in zip(names, (25.0, 24.0, 24.5), (10.0, 5.0, 20.0))
        for s in (0, 1)
    ]
    default, others = curves.points_of(runs, chosen)
    assert default is not None
    front = {r.name: r.value for r in curves.rows_of("room", default, others) if "front" in r.name}
    assert list(front.values()) == ["yes", "yes", "no"]


def test_what_beats_the_default_by_more_than_the_noise_is_named() -> None:
    names = ("fast", "better", "noise", "slower")
    chosen = {"a": {name: name for name in names}}

    def run(name: str, seed: int, wall: float, psnr: float) -> Run:
        return Run("room", "full", seed, Path("x"), report(psnr, wall), name)

    runs = [run("default", 0, 10.0, 25.0), run("default", 1, 10.4, 25.2)]
    others = {"fast": (9.0, 25.0), "better": (10.3, 26.0), "noise": (9.9, 25.2), "slower": (12.0, 27.0)}
    runs += [run(f"a_{name}", 0, *figures) for name, figures in others.items()]
    default, points = curves.points_of(runs, chosen)
    assert default is not None
    assert default.noise == pytest.approx((0.2, 0.1))
    assert [point.label for point in points if point.beats(default)] == ["fast", "better"]
    rows = {r.name: r.value for r in curves.rows_of("room", default, points)}
    assert rows["room: default: beaten by"] == "a = fast, a = better"
    assert rows["room: default: half the range of its wall times"] == pytest.approx(0.2)
    assert rows["room: default: half the range of its held-out PSNR"] == pytest.approx(0.1)
    assert rows["room: a fast: splats"] == 1000
    once, _ = curves.points_of(runs[1:], chosen)
    assert once is not None
    assert curves.rows_of("room", once, points)[-1].value == "unknown"
    assert curves.points_of(runs[2:], chosen)[0] is None


def test_the_default_runs_in_turns_with_the_curves_with_their_seeds() -> None:
    chosen = {name: {"1": "1"} for name in ("a", "b", "c", "d")}
    found = curves.matrices_of("room", chosen, [5], 3, ["dataset.stop=60"])
    names = [name.removeprefix("room/") for name in found]
    assert names == ["default/0", "a", "b", "default/1", "c", "d", "default/2"]
    assert [list(found[f"room/{name}"].seeds) for name in names] == [[5], [5], [5], [6], [5], [5], [7]]
    assert next(iter(curves.matrices_of("room", chosen, [0], 1, []))) == "room/default/0"
    assert all(matrix.overrides == ["dataset.stop=60"] for matrix in found.values())


def test_stress_passes_what_holds_or_says_that_it_does_not() -> None:
    easy = stress.Outcome.of(a_run())

    def outcome(found: stress.Outcome, beside: stress.Outcome | None = easy) -> Row:
        return next(row for row in stress.rows_of("x", found, beside) if row.name == "x: outcome")

    def verdict(**trajectory: Any) -> Row:
        path = {**report()["trajectory"], **trajectory}
        return outcome(stress.Outcome.of(a_run(trajectory=path)))

    assert outcome(easy, None).met
    assert not any(row.name == "x: it said" for row in stress.rows_of("x", easy, None))

    assert not verdict(ate_percent=30.0).met  # broken, and not a word
    assert verdict(ate_percent=30.0, frames_tracked=50).met
    photographs = report(rendering={"held_out": {"psnr": None}, "keyframes": {"psnr": 22.0}})
    mapped = stress.Outcome.of(Run("fox", "full", 0, Path("x"), photographs))
    assert mapped.kept_a_map
    assert any(row.name == "fox: keyframes PSNR" and row.value == 22.0 for row in stress.rows_of("fox", mapped, None))
    nothing = stress.Outcome.of(Run("room", "full", 0, Path("x"), None))
    assert not outcome(nothing).met  # not even a report
    assert "no map" in str(outcome(nothing).value)
    assert stress.rows_of("x", nothing, easy)[-1].name == "x: it said"


def test_memory_that_grows_is_told_from_memory_that_does_not() -> None:
    flat = [(float(t), 100.0 if t > 5 else 10.0) for t in range(100)]
    grows = [(float(t), 100.0 + t) for t in range(100)]
    assert memory.growth(flat) == 1.0
    assert memory.growth(grows) > 1.4
    log = "23:59:58.000 starting\n23:59:58.100 waiting\n00:00:01.500 running\n00:01:00.000 ending\n00:01:00.010 done\n"
    assert memory.stream(log, {"dataset": flat}) == (3.5, 99.0)


@pytest.mark.slow
def test_each_benchmark_explains_itself() -> None:
    """All in one process: most of the time goes into imports."""
    code = (
        "import runpy, sys\n"
        "for name in sys.argv[1:]:\n"
        "    sys.argv = [name, '--help']\n"
        "    try: runpy.run_module('bench.' + name, run_name='__main__')\n"
        "    except SystemExit as ended: assert ended.code == 0, name\n"
    )
    names = [*BENCHMARKS, "record", "compare", "baselines.colmap_poses"]
    assert {"scenes", "baselines", "stress", "curves", "ablation"} <= set(names)
    done = subprocess.run([sys.executable, "-c", code, *names], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.count("usage:") == len(names)
    assert done.stdout.count("--quick") >= len(BENCHMARKS)
