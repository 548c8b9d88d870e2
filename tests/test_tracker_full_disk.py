"""A disk that is full while a tracker runs: what it cannot write is said once, and the run goes on."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from msgs import Frame
from mvsgs_core.kept_map import tracker_file
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.tracker import NewestPose
from nodes.localization_file import FILE, LocalizationFile
from nodes.returning import Returning
from nodes.tracker import Tracker
from nodes.tracking import TrackerNode
from tests.support.full_disk import full_after
from tests.support.keyframe_messages import keyframe

FRAME = Frame(7, 0.7, np.zeros((2, 2, 3), np.uint8), np.ones(4))
FOUND = NewestPose(np.eye(4), 0, None, 0.9)


def test_it_costs_the_return_and_not_the_run(tmp_path: Path) -> None:
    stats = Stats()
    returning = Returning(tmp_path, stats)
    returning.note(keyframe(0))
    with full_after(4):
        for index in (1, 2):
            returning.note(keyframe(index))
    (warning,) = stats.warnings
    assert warning.startswith("if this tracker is killed it cannot go on: ")
    again = Returning(tmp_path, stats)
    assert again.returned
    with pytest.raises(ValueError, match="the disk was full"):
        again.known()  # what it does not know of would be laid over with another map


def test_it_costs_lines_and_is_said_once(tmp_path: Path) -> None:
    stats = Stats()
    file = LocalizationFile(tmp_path, stats)
    file.add(FRAME, FOUND)
    with full_after(4):
        file.add(FRAME, FOUND)
        file.close()
    (warning,) = stats.warnings
    assert warning.startswith(f"{tmp_path / FILE} cannot be written: ")
    assert len((tmp_path / FILE).read_text().splitlines()) == 2


def test_it_does_not_cost_the_map_that_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / FILE).symlink_to("/dev/full")
    node = Tracker(Tracker.Config(output=str(tmp_path), keep_map=True))
    kept: list[Path] = []
    monkeypatch.setattr(node.core, "keep_map", kept.append)
    monkeypatch.setattr(TrackerNode, "on_end", lambda _: itertools.repeat(None, 0))
    node._localized.add(FRAME, FOUND)
    assert list(node.on_end()) == []
    assert kept == [tracker_file(tmp_path)]
    assert len(node.stats.warnings) == 1
