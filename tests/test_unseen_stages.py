"""What a run's folder and its last lines say where stages elsewhere have not been heard to the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from launch.jobs import elsewhere
from launch.outcome import Failure, Outcome
from launch.output import Output, read_report
from mvsgs_core.mapping.checkpoints.files import CheckpointInfo

HALFWAY = CheckpointInfo(Path("state-00000001.npz"), 40, 4.0, np.arange(5) * 10, 1000, finished=False)
UNSEEN = Outcome(1, "mapper is external: its end is not known here", unseen=("mapper",))


@pytest.fixture
def output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Output:
    """With an evaluator's report and a checkpoint."""
    monkeypatch.setattr("launch.output.checkpoint_info", lambda folder: HALFWAY)
    claimed = Output(tmp_path)
    claimed.begin({}, "mvsgs", resumed=False)
    claimed.write_report({"finished": True, "rendering": {"psnr": 30.0}})
    (tmp_path / "checkpoint").mkdir()
    return claimed


def test_a_report_beside_a_stage_whose_end_is_not_known_is_of_no_finished_run(output: Output) -> None:
    for _ in range(2):  # once before a viewer is closed, and once after
        assert output.settle(UNSEEN, scored=True, keep=False) is None
        report = read_report(output.path)
        assert (report["finished"], report["reason"]) == (False, UNSEEN.reason)
        assert report["rendering"] == {"psnr": 30.0}
        assert report["resume"] == output.resume is not None
    assert (output.path / "checkpoint").exists()


@pytest.mark.parametrize("ended", [Outcome(), Outcome(4, observers=(Failure("viewer", "gone"),))])
def test_a_report_of_a_run_that_ended_stays_as_it_is(output: Output, ended: Outcome) -> None:
    assert output.settle(ended, scored=True, keep=False) is None
    report = read_report(output.path)
    assert (report["finished"], "reason" in report) == (True, False)
    assert not (output.path / "checkpoint").exists()


def test_nobody_is_told_to_go_on_beside_a_stage_that_may_still_work(output: Output) -> None:
    output.settle(UNSEEN)
    still = "mapper still works, or has ended, where it was started: what it makes is there"
    assert elsewhere(("mapper",), output).splitlines() == ["", still, f"if it did not end well: {output.resume}"]
    output.resume = None
    assert elsewhere(("mapper",), output).splitlines() == ["", still]
