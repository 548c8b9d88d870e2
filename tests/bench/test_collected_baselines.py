"""Baselines of which a folder is only read: nothing is started, and what is missing is said."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.baselines import __main__ as baselines
from bench.baselines import colmap_poses, offline
from bench.baselines.colmap_poses import Model
from bench.baselines.offline import Trained, Way
from bench.baselines.ours import Ours
from bench.table import Row
from tests.support.offline_peers import NOTHING, by_name, six_frames


def test_a_collected_table_says_what_is_missing_and_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither COLMAP nor the offline map nor OpenSplat; what is there is of the commit that measured it."""
    posed = Model(np.array([0, 5]), np.tile(np.eye(4), (2, 1, 1)), NOTHING, NOTHING, {}, 9.0)
    started: list[Any] = []

    def reconstruct(frames: dict[int, np.ndarray], intrinsics: np.ndarray, place: Path, *_: Any) -> tuple[Model, str]:
        started.append("COLMAP")
        (place / "model.npz").touch()
        return posed, ""

    def train(model: Model, ours: Ours, way: Way, seconds: float, threads: int) -> Trained:
        started.append("training")
        return Trained(seconds, 20.0, 0.8, 10, 20, seconds, way.name)

    ours = six_frames()
    monkeypatch.setattr(baselines, "run_ours", lambda *_: (ours, {}))
    monkeypatch.setattr(baselines, "read_frames", lambda _: ours.frames)
    monkeypatch.setattr(baselines, "opensplat_rows", lambda _, binary, *__: started.append(binary) or [])
    monkeypatch.setattr(colmap_poses, "reconstruct", reconstruct)
    monkeypatch.setattr(colmap_poses, "load", lambda _: posed)
    monkeypatch.setattr(offline, "train", train)

    def measured(**options: Any) -> dict[str, Row]:
        given = {"resume": False, "collect": False, "minutes": None, "quick": True, "overrides": [], "fewer": {},
                 "threads": 1, "opensplat": None, "output": tmp_path, "scenes": ["room"], **options}  # fmt: skip
        return by_name(baselines.measure(argparse.Namespace(**given)))

    missing = "not run yet (--resume goes on with them)"
    assert measured(collect=True)[missing].value == "room/colmap/model.npz"
    assert started == []
    assert missing not in measured()
    assert started == ["COLMAP", "training", None]
    for file in tmp_path.rglob("*.asked"):
        file.write_text(json.dumps({**json.loads(file.read_text()), "commit": "abc1234"}))
    rows = measured(collect=True)
    assert missing not in rows
    assert rows["runs of the commits"].value == "abc1234"
    assert measured(collect=True, opensplat=Path("opensplat"))[missing].value == "room/opensplat"
    (kept,) = (tmp_path / "room" / "trained").glob("*.json")
    kept.unlink()
    rows = measured(collect=True)
    assert str(rows[missing].value).startswith("room/trained/")
    assert "room: poses, COLMAP: seconds" in rows
    assert set(started[3:]) == {None}
