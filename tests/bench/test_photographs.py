"""What bench.photographs says of a run: of which photographs, with which focal length."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import photographs
from bench.baselines import offline
from bench.baselines.colmap_poses import Model
from bench.baselines.offline import Trained, Way
from bench.baselines.ours import Ours
from bench.photographs import our_rows, with_focal
from bench.pieces import Kept
from bench.table import Row
from msgs import GroundTruth


def ours() -> Ours:
    """Photographs 0 to 10, of which 0, 5 and 10 are held out."""
    image = np.zeros((4, 6, 3), np.uint8)
    frames = {i: GroundTruth(i, i / 30, image, np.array([9.0, 9.5, 2.5, 1.5]), None, None) for i in range(11)}
    scores = [
        {"index": i, "held_out": i % 5 == 0, "psnr": 20.0 + i, "coverage": 0.9 + 0.01 * i} for i in frames if i != 3
    ]
    report = {"rendering": {"frames": scores}, "map": {"splats": 7}, "time": {"cpu": {"mapper": 3.0, "evaluator": 9.0}}}
    track = {
        "index": list(frames),
        "keyframe": [i % 5 != 0 for i in frames],
        "world_from_cam": [np.eye(4).tolist() if i != 3 else None for i in frames],
    }
    return Ours(report, track, frames)


def test_only_held_out_photographs_that_both_have_count() -> None:
    rows = {row.name: row for row in our_rows("a", ours(), {5, 6, 10})}
    assert rows["a: photographs with a pose"].value == "10 of 11"
    assert rows["a: held-out PSNR, all"].value == 25.0
    assert rows["a: held-out PSNR, those that count"].value == 27.5
    assert (rows["a: worst held-out photograph"].value, rows["a: worst held-out photograph"].unit) == (25.0, "dB (5)")
    assert rows["a: held-out pixels covered"].value == pytest.approx(97.5)
    assert rows["a: held-out pixels covered"].met
    assert rows["a: seconds, photographs to map"].value == 3.0  # the evaluator is no part of it


def test_theirs_have_their_own_focal_length() -> None:
    changed = with_focal(ours(), 12.0)
    assert changed.frames[4].intrinsics.tolist() == [12.0, 12.0, 2.5, 1.5]
    assert changed.keyframes == ours().keyframes


def test_a_scene_says_which_of_its_parts_are_of_another_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[str] = []

    def colmap(ours: Ours, place: Path, kept: Kept) -> tuple[Model, str]:
        place.mkdir(parents=True, exist_ok=True)
        (place / "model.npz").write_text("a model")
        none = np.zeros(0)
        return Model(np.array([0, 5, 10]), none, none, none, {}, 9.0, 12.0), ""

    def train(model: Model, ours: Ours, way: Way, seconds: float, threads: int) -> Trained:
        trained.append(way.name)
        return Trained(seconds, 20.0, 0.8, 10, 20, seconds, way.name)

    monkeypatch.setattr(photographs, "colmap", colmap)
    monkeypatch.setattr(offline, "train", train)
    mapped = replace(ours(), report={**ours().report, "map": {"splats": 7, "iterations": 90}})
    monkeypatch.setattr(photographs, "run_ours", lambda *_: (mapped, {}))

    def said(resume: bool) -> list[Any]:
        options = argparse.Namespace(resume=resume, overrides=[], quick=True)
        rows: list[Row] = photographs.compare("a", options, tmp_path)
        return [row.value for row in rows if row.name == "a: runs of the commits"]

    assert said(False) == []
    (file,) = (tmp_path / "a" / "trained").glob("*.asked")
    file.write_text(json.dumps({**json.loads(file.read_text()), "commit": "abc1234"}))
    assert said(True) == ["abc1234"]
    assert len(trained) == 1
