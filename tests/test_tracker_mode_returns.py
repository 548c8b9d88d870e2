"""What a tracker that was killed had been asked for: its mode, another map, and the lines of localization.csv."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import Frame, Request
from mvsgs_core.stats import Stats
from mvsgs_core.tracking.tracker import NewestPose
from nodes.localization_file import FILE, HEADER, LocalizationFile
from nodes.returning import Returning
from nodes.tracker import Tracker


def tracker(kept_in: Path, **changes: Any) -> Tracker:
    node = Tracker(Tracker.Config(**changes))
    node.kept_in = kept_in
    return node


def begun_on_a_map(kept_in: Path, monkeypatch: pytest.MonkeyPatch) -> Tracker:
    monkeypatch.setattr("nodes.tracker._known", lambda folder: object())  # one that is never looked into
    return tracker(kept_in, map="somewhere")


def ask(node: Tracker, number: int, asked: str) -> None:
    (request,) = [m for m in node.on_request(Request(number, asked, kept="nothing to keep")) if isinstance(m, Request)]
    assert not request.problem


def test_after_a_reset_it_comes_back_in_a_new_map_that_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed = begun_on_a_map(tmp_path, monkeypatch)
    ask(killed, 1, "localize")
    assert killed.core.frozen
    localizing = begun_on_a_map(tmp_path, monkeypatch)
    localizing._begin()
    assert (localizing.core.frozen, localizing.core._known is None) == (True, False)
    ask(localizing, 2, "reset")
    assert not Returning(tmp_path, Stats()).frozen
    again = begun_on_a_map(tmp_path, monkeypatch)
    again._begin()
    assert (again.core.frozen, again.core._known is None) == (False, True)
    assert "begins another map" in again.stats.warnings[-1]
    assert (killed._localized._mode, again._localized._mode) == ("w", "a")


def test_after_a_reset_its_corrections_are_newer_than_those_before(tmp_path: Path) -> None:
    killed = tracker(tmp_path)
    killed._begin()
    (tmp_path / "sent").write_text("\nKeyframe 3;\nPoses 7;")
    ask(killed, 1, "reset")
    again = tracker(tmp_path)
    again._begin()
    assert again._revision == 7


def test_localization_goes_on_below_the_lines_of_the_process_before(tmp_path: Path) -> None:
    found = NewestPose(np.eye(4), 0, None, 0.5)
    for n, returned in enumerate((False, True, True)):
        file = LocalizationFile(tmp_path, Stats())
        if returned:
            file.go_on()
        file.add(Frame(n, 0.1 * n, np.zeros((2, 2, 3), np.uint8), np.ones(4)), found)
        file.close()
    lines = (tmp_path / FILE).read_text().splitlines()
    assert lines[0] == HEADER
    assert [line.partition(",")[0] for line in lines[1:]] == ["0", "1", "2"]
