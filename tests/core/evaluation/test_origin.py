"""What the report says of the run that it is of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core import machine
from mvsgs_core.datasets.lens import guess_lens
from mvsgs_core.evaluation.html import sorted_warnings
from mvsgs_core.evaluation.origin import SETTINGS, in_words, origin
from mvsgs_core.evaluation.statistics import collected
from mvsgs_core.export.source_camera import LENS, lens_values
from mvsgs_core.trajectory import Trajectory

STATISTICS = {"dataset": {"values": {LENS: lens_values(guess_lens((480, 640)))}}}


def words(folder: Path | None, size: tuple[int, int] | None = None) -> dict[str, str]:
    report: dict[str, Any] = {"input": "video walk.mp4", "date": "today", "version": "9", "trajectory": {"frames": 30}}
    report["run"] = origin(folder, size, Trajectory.empty(), STATISTICS)
    return in_words(report)


def test_command_settings_camera_and_machine_are_there(tmp_path: Path) -> None:
    (tmp_path / SETTINGS).write_text(
        "# mvsgs dataset=video dataset.path=walk.mp4\noutput: x\nmapper:\n  iterations: 3\n"
    )
    found = words(tmp_path, (240, 320))
    assert found["command"] == "mvsgs dataset=video dataset.path=walk.mp4"
    assert found["stream"] == "30 frames, mapped at 320x240 pixels"
    assert found["camera"].startswith("focal length 502.3 px at 640x480, guessed; doubtful: ")
    assert found["processor"] == machine.processor()
    assert {"memory", "GPU", "system", "output", "finished", "version"} <= set(found)
    assert origin(tmp_path, None, None, {})["settings"] == "output: x\nmapper:\n  iterations: 3"


def test_what_is_not_known_is_left_out() -> None:
    found = words(None)
    assert found["stream"] == "30 frames"
    assert not {"command", "output"} & set(found)
    assert origin(None, None, None, {})["settings"] is None


def test_the_streams_length_is_that_of_its_times() -> None:
    empty = vars(Trajectory.empty())
    track = Trajectory(**{**empty, "timestamp": np.array([5.0, np.nan, 7.5])})
    assert origin(None, None, track, {})["stream_seconds"] == 2.5


def test_warnings_stand_in_the_order_of_what_they_cost() -> None:
    report = {
        "warnings": {"evaluator": ["no LPIPS"], "mapper": ["full"], "dataset": ["a guess"], "tracker": ["lost"]},
        "nothing": {"mapper": "no depth"},
        "notes": ["no true poses"],
    }
    assert sorted_warnings(report) == [
        "mapper: no depth", "tracker: lost", "dataset: a guess", "mapper: full", "no true poses", "evaluator: no LPIPS",
    ]  # fmt: skip
    report |= collected(
        {"dataset": {"values": {"cut_off": "ended by Ctrl-C"}, "warnings": ["a guess", "ended by Ctrl-C"]}}
    )
    assert sorted_warnings(report) == [
        "dataset: ended by Ctrl-C",
        "mapper: no depth",
        "dataset: a guess",
        "no true poses",
    ]
