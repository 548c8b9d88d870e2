"""A run that loses a stage leaves a map and goes on from there; one that loses its observers does not mind."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path

import psutil
import pytest

from bench.faults.kills import SCENE
from bench.faults.launched import Launched, map_opens
from tests.support.launches import DOWN, gone

pytestmark = pytest.mark.slow

SHORT = (
    *SCENE, "dataset.options.frames=40", "mapper.iterations=3", "mapper.refinement=5", "evaluator.max_frames=3",
    "evaluator.fitted=false", "dataset.realtime=false",  # a frame that a busy machine let pass would be another map
)  # fmt: skip


def test_a_run_whose_mapper_was_killed_leaves_a_map_and_is_resumed(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with Launched(output, (*SHORT, f"output={output}")) as run:
        assert run.wait_for((output / "map.ply").exists), run.said()
        nodes = psutil.Process(run.process.pid).children()
        assert run.send("mapper", signal.SIGKILL)
        assert gone(nodes, DOWN)
        assert run.wait() == 1
        assert run.left() == []
        report, said = run.report(), run.said()
    assert map_opens(output)
    assert (report["finished"], report["failed"]) == (False, "mapper")
    assert report["error"].startswith("killed by signal 9")
    assert report["resume"].endswith(f"run_all.py resume={output}")
    assert said.rstrip().splitlines()[-2:] == [
        f"unfinished: the map so far is {output / 'map.ply'}",
        f"go on with it: {report['resume']}",
    ]
    with Launched(output, (f"resume={output}", "seed=0")) as run:
        assert run.wait() == 0, run.said()
        report = run.report()
    assert report["finished"] is True
    assert report["rendering"]["held_out"]["count"] > 0
    assert report["trajectory"]["frames"] == 40
    assert not (output / "previous").exists()
    assert not (output / "checkpoint").exists()
    with Launched(output, (f"resume={output}",)) as run:
        assert run.wait() == 2
        assert "has reached its end" in run.said()


def test_observers_without_room_on_their_disk_cost_no_map(tmp_path: Path) -> None:
    output = tmp_path / "out"
    full = (
        "recorder._target_=bench.faults.full_disk.FullRecorder",
        "evaluator._target_=bench.faults.full_disk.FullEvaluator",
    )
    with Launched(output, (*SHORT, f"output={output}", "recorder=mcap", *full)) as run:
        assert run.wait() == 4, run.said()
        said = run.said()
    for observer in ("recorder", "evaluator"):
        assert re.search(
            rf"{observer} failed: (OSError: \[Errno|could not write) .*; the run goes on without it", said
        ), said
    report = json.loads((output / "report.json").read_text())
    assert set(report["observers"]) == {"recorder", "evaluator"}
    assert map_opens(output)


def test_the_report_of_a_run_that_lost_its_evaluator_can_still_be_made(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with Launched(output, (*SHORT, f"output={output}")) as run:
        assert run.wait_for((output / "map.ply").exists), run.said()
        assert run.send("evaluator", signal.SIGKILL)
        assert run.wait() == 4, run.said()
        report, said = run.report(), run.said()
    assert (report["finished"], report["map"]) == (False, "finished")
    assert said.rstrip().endswith(f"its report is still to be made: {report['resume']}")
    finished = (output / "map.ply").read_bytes()
    with Launched(output, (f"resume={output}",)) as run:
        assert run.wait() == 0, run.said()
        assert run.report()["finished"] is True
    assert (output / "map.ply").read_bytes() == finished
    assert not (output / "checkpoint").exists()
