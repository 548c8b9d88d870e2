"""Offline peers: the same frames, equal processor time, their best way; OpenSplat by a stand-in of its binary."""

from __future__ import annotations

import argparse
import json
import stat
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bench import figures, photographs
from bench.baselines import __main__ as baselines
from bench.baselines import colmap_poses, offline, opensplat
from bench.baselines.colmap_poses import Model
from bench.baselines.offline import Trained, Way
from bench.baselines.ours import ate_percent, cheapest, iterations_of, run_ours
from bench.baselines.sparse_splats import Posed, SparseConfig, SparseMap
from bench.pieces import Kept, Pieces
from bench.runs import Run, fewer_iterations
from mvsgs_core.datasets import open_dataset
from mvsgs_core.export.ply import write_ply
from mvsgs_core.export.snapshot import Snapshot
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.rasterizer.splats import Splats
from tests.support.offline_peers import NOTHING, by_name, report, six_frames

ON_CPU = MapperConfig(threads=1, device="cpu")
NO_MODEL = Model(NOTHING, NOTHING, NOTHING, NOTHING, {"mapping": 5.0}, 9.0)


def test_ours_has_its_frames_its_times_and_its_exposures() -> None:
    ours = six_frames()
    assert (ours.keyframes, ours.held_out, ours.not_held_out) == ([0, 3], [5], [0, 1, 2, 3, 4])
    assert (ours.optimization, ours.everything) == (3.0, 4.0)  # of the processor; the evaluator is no part of it
    assert ours.psnr({3, 5}) == 25.0
    assert ours.exposures is None
    known = six_frames({"exposure": [np.eye(3, 4).tolist(), None, (2 * np.eye(3, 4)).tolist()]}).exposures
    assert known is not None
    assert known.keys() == {0, 5}
    assert known[5][1, 1] == 2.0


def test_a_run_of_ours_is_called_by_its_own_iterations() -> None:
    plain = {"iterations": None, "refinement": None, "realtime": False}
    assert iterations_of(plain) == f"{MapperConfig().budget} a keyframe"
    assert iterations_of({**plain, "iterations": 7, "refinement": 50}) == "7 a keyframe, 50 at the end"
    assert list(fewer_iterations("7:50,5")) == ["7 a keyframe, 50 at the end", "5 a keyframe"]  # as the others


def test_a_run_that_is_missing_is_not_taken_from_an_earlier_call(tmp_path: Path) -> None:
    left = tmp_path / "ours" / "5_a_keyframe" / "0"
    left.mkdir(parents=True)
    (left / "report.json").write_text(json.dumps(report()))
    fewer = {"5 a keyframe": ("mapper.iterations=5",)}
    ours, others = run_ours("room", [], fewer, tmp_path / "ours", Pieces(tmp_path, collect=True))
    assert ours is None
    assert others["5 a keyframe"].report is None


def test_colmap_s_model_of_other_images_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def reconstruct(frames: dict[int, np.ndarray], *args: Any) -> tuple[Model, str]:
        made.append(frames[0].size)
        (args[1] / "model.npz").touch()
        return NO_MODEL, ""

    monkeypatch.setattr(colmap_poses, "reconstruct", reconstruct)
    monkeypatch.setattr(colmap_poses, "load", lambda folder: NO_MODEL)
    for size, resume in ((4, True), (4, True), (6, True), (6, False)):
        small = six_frames()
        frames = {0: replace(small.frames[0], image=np.zeros((2, size, 3), np.uint8))}
        assert photographs.colmap(replace(small, frames=frames), tmp_path, Kept(resume)) == (NO_MODEL, "")
    assert made == [24, 36, 36]


def test_theirs_is_scored_where_ours_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A held-out frame of which ours has no pose counts for neither."""
    ours = six_frames()
    frames = {**ours.frames, 10: replace(ours.frames[5], index=10)}
    ours = replace(ours, frames=frames)
    assert ours.held_out == [5, 10]
    assert ours.scored == [5]
    scored: list[int] = []

    class Map:
        seconds, iterations, state = 1.0, 1, ()

        def __init__(self, views: list[Posed], *_: Any) -> None:
            self.views = views

        def optimize(self) -> None:
            trained.append([view.index for view in self.views])

        def render(self, view: Posed) -> np.ndarray:
            scored.append(view.index)
            return view.image / np.float32(255.0)

    trained: list[list[int]] = []
    monkeypatch.setattr(offline, "SparseMap", Map)
    monkeypatch.setattr(offline, "score", lambda pairs: (float(len(list(pairs))), 1.0))
    known = np.array([0, 1, 2, 3, 4, 5, 10])
    model = replace(NO_MODEL, index=known, world_from_cam=np.tile(np.eye(4), (7, 1, 1)))
    offline.train(model, ours, Way(frames="all"), 1.0, 1)
    assert scored == [5]
    assert trained == [[0, 1, 2, 3, 4]]


def test_theirs_gets_photographs_that_ours_could_not_register() -> None:
    for quick in (False, True):
        assert photographs.ways(argparse.Namespace(quick=quick))["frames"] == ("all",)


def test_the_error_of_other_poses_is_taken_over_common_frames_after_alignment() -> None:
    ours = six_frames()
    theirs = {i: np.array(f.world_from_cam) for i, f in ours.frames.items() if i != 2}
    for pose in theirs.values():
        pose[:3, 3] = 3.0 * pose[:3, 3] + 7.0
    assert ate_percent(theirs, ours, list(range(6))) == pytest.approx(0.0, abs=1e-9)
    theirs[4][:3, 3] += 1.0
    worse = ate_percent(theirs, ours, list(range(6)))
    assert worse is not None
    assert worse > 1.0
    assert ate_percent(theirs, ours, [0, 2]) is None


def test_theirs_is_trained_in_every_way_and_the_best_goes_on_until_twice_the_time_brings_little(tmp_path: Path) -> None:
    scores = {3.0: 20.0, 6.0: 22.0, 12.0: 22.5, 24.0: 22.55, 48.0: 30.0}
    asked: list[tuple[Way, float]] = []

    def train(way: Way, seconds: float) -> Trained:
        asked.append((way, seconds))
        psnr = scores.get(seconds, 20.0) - (way.exposure == "none") - (way.frames == "keyframes") - way.settle
        psnr += way.rates == "ours"
        return Trained(seconds + 0.1, psnr, 0.8, 10, 20, seconds, way.name)

    ours = six_frames()
    measured = offline.choices(six_frames({"exposure": [None] * 3}))
    assert measured["exposure"] == ("none", "trained", "tracker")  # where our tracker has exposures, theirs too
    model, place = tmp_path / "model.npz", tmp_path / "trained"
    model.write_bytes(b"a model")
    kept = offline.kept_in(place, model, Kept(False), train)
    best, tried = offline.best_way(offline.choices(ours), kept, ours.optimization)
    assert best == Way("all", "trained", "ours", 0.1)
    assert len(tried) == 6
    cut_short = offline.train_longer(best, kept, 3.0, 2.0)
    assert not offline.converged(cut_short)
    again = offline.kept_in(place, model, Kept(True), train)
    found = offline.train_longer(best, again, 3.0, 64.0)
    assert [seconds for _, seconds in asked] == [3.0] * 6 + [6.0, 12.0, 24.0]  # what is kept is not made again
    assert offline.converged(found)
    rows = by_name(baselines.longer_rows("room", NO_MODEL, found))
    assert rows["room: map, COLMAP + splatting, 8 times as long: gain by twice the time"].value == pytest.approx(0.05)
    assert rows["room: map, COLMAP + splatting, equal time: seconds, frames to map"].value == pytest.approx(12.1)
    assert rows["room: COLMAP + splatting, gain by the last doubling of its time"].met
    short = by_name(baselines.longer_rows("room", NO_MODEL, cut_short))
    assert not short["room: COLMAP + splatting, gain by the last doubling of its time"].met
    again(best, 3.5)
    assert asked[-1] == (best, 3.5)  # results of another time are no start
    count = len(asked)
    model.write_bytes(b"another model")
    offline.kept_in(place, model, Kept(True), train)(best, 3.5)
    assert len(asked) == count + 1  # nor are those of other poses and points


def test_ours_is_to_be_better_at_equal_time_and_as_good_in_a_tenth_of_theirs() -> None:
    model = Model(np.array([5]), np.eye(4)[None], np.zeros((0, 3)), np.zeros((0, 3)), {}, 31.0)
    equal = Trained(3.0, 24.4, 0.8, 10, 20, 3.0, "all")
    fewer = {"5": Run("room", "full", 0, Path("x"), report(24.5, 1.0)), "1": Run("room", "full", 0, Path("x"), None)}
    rows = by_name(baselines.verdict("room", six_frames(), fewer, model, equal))
    ahead = rows["room: ours minus theirs, equal time"]
    assert (ahead.value, ahead.met) == (pytest.approx(0.6), True)
    share = rows["room: time from frames to their PSNR, ours over theirs"]
    assert (share.value, share.met) == (pytest.approx(2.0 / 34.0), True)
    assert cheapest(six_frames(), fewer, 24.8, {5}) == ("15 a keyframe", 4.0)
    apart = report(30.0, 0.5)  # better only where COLMAP has no pose
    apart["rendering"]["frames"] = [{"index": i, "psnr": p, "held_out": True} for i, p in ((5, 20.0), (10, 50.0))]
    assert cheapest(six_frames(), {"5": Run("room", "full", 0, Path("x"), apart)}, 24.8, {5}) == ("15 a keyframe", 4.0)
    worse = by_name(baselines.verdict("room", six_frames(psnr=24.0), {}, model, equal))
    assert [row.met for row in worse.values()] == [None, False, False]


def room(every: int, gain: Any = None) -> tuple[list[Posed], list[Posed], np.ndarray, np.ndarray]:
    """Views to train on, those between, points and their colors; gain: of the light, by the frame's number."""
    items = list(open_dataset("synthetic", scene="room", frames=12, size=(48, 64), threads=1))
    points, colors, views = [], [], []
    for k, item in enumerate(items):
        assert item.depth is not None
        assert item.world_from_cam is not None
        image = item.image
        if gain is not None:
            image = np.clip(image.astype(np.float32) * gain(k), 0, 255).round().astype(np.uint8)
        views.append(Posed(item.index, image, item.intrinsics, item.world_from_cam, 0.1 * k))
        if k % every == 0:
            v, u = np.mgrid[2:48:3, 2:64:3].reshape(2, -1)
            fx, fy, cx, cy = item.intrinsics
            z = item.depth[v, u].astype(np.float64)
            seen = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
            points.append(seen @ item.world_from_cam[:3, :3].T + item.world_from_cam[:3, 3])
            colors.append(item.image[v, u])
    between = [view for k, view in enumerate(views) if k % every]
    return views[::every], between, np.concatenate(points), np.concatenate(colors)


@pytest.mark.slow
def test_offline_splatting_of_sparse_points_gets_better() -> None:
    views, _, points, colors = room(4)
    fitted = SparseMap(views, points, colors, SparseConfig(iterations=120, mapper=ON_CPU))

    def error() -> float:
        return float(np.mean([(fitted.render(v) - v.image / 255.0) ** 2 for v in views]))

    before = error()
    fitted.optimize()
    assert fitted.iterations == 120
    assert error() < 0.5 * before
    with pytest.raises(ValueError, match="no start"):
        SparseMap(views, np.zeros((2, 3)), np.zeros((2, 3), np.uint8), SparseConfig())


def test_what_only_waits_is_not_counted_as_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch's own threads spin while they wait, and a process's time is that of all its threads."""
    views, _, points, colors = room(4)
    before, seen = torch.get_num_threads(), []
    step = SparseMap._step
    monkeypatch.setattr(SparseMap, "_step", lambda *args: (seen.append(torch.get_num_threads()), step(*args))[1])
    try:
        torch.set_num_threads(2)
        SparseMap(views, points, colors, SparseConfig(iterations=2, mapper=ON_CPU)).optimize()
    finally:
        torch.set_num_threads(before)
    assert seen == [1, 1]


@pytest.mark.slow
def test_a_known_exposure_is_of_use_to_the_offline_map() -> None:
    """Light that changes by the frame: frames between have the exposure that is known of them, and what was trained."""

    def gain(k: int) -> float:
        return 1.0 - 0.05 * k

    training, between, points, colors = room(2, gain)
    psnr = {}
    for known in (False, True):

        def posed(view: Posed, known: bool = known) -> Posed:
            exposure = np.eye(3, 4) * gain(round(view.timestamp / 0.1)) if known else None
            return Posed(view.index, view.image, view.intrinsics, view.world_from_cam, view.timestamp, exposure)

        fitted = SparseMap([posed(v) for v in training], points, colors, SparseConfig(iterations=150, mapper=ON_CPU))
        fitted.optimize()
        psnr[known], _ = offline.score((posed(v), fitted.render(posed(v))) for v in between)
    assert psnr[True] > psnr[False] + 1.0
    assert fitted.exposure_of(training[0]) is None
    found = fitted.exposure_of(posed(between[1], True))
    assert found is not None
    assert np.allclose(found, np.eye(3, 4) * gain(3), atol=0.05)


@pytest.mark.slow
def test_what_an_exposure_is_off_by_is_trained() -> None:
    """Light that falls by the frame, of which nobody knows."""
    training, _, points, colors = room(2, lambda k: 1.0 - 0.05 * k)
    views = [replace(view, exposure=np.eye(3, 4)) for view in training]
    fitted = SparseMap(views, points, colors, SparseConfig(iterations=120, mapper=ON_CPU))
    fitted.optimize()
    found = [fitted.exposure_of(view) for view in views]
    gains = [float(np.trace(affine[:, :3])) / 3.0 for affine in found if affine is not None]
    assert len(gains) == len(views)
    assert gains[0] > gains[-1] + 0.01


def a_map(file: Path, color: float) -> None:
    """A wall of splats across the whole view, of one gray."""
    y, x = np.mgrid[-7:7:0.4, -9:9:0.4].reshape(2, -1)
    means = torch.from_numpy(np.stack([x, y, np.full_like(x, 4.0)], axis=1).astype(np.float32))
    count = len(means)
    splats = Splats(
        means, torch.full((count, 3), -1.0), torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count,), 8.0),
        torch.full((count, 1, 3), (color - 0.5) / 0.28209479), torch.full((count,), 2.0),
    )  # fmt: skip
    none = np.zeros(0)
    empty = Snapshot(splats, np.zeros(count, np.int64), np.zeros(3), "gaussian", 0, none.astype(np.int64),
                     np.zeros((0, 4, 4)), none, np.zeros((0, 3, 4), np.float32))  # fmt: skip
    write_ply(file, empty)


def stand_in(file: Path, result: Path, fails_at: int | None = None) -> Path:
    """A program with OpenSplat's command line that trains nothing: it checks its project, and copies a map."""
    file.write_text(
        f"#!{sys.executable}\n"
        "import pathlib, shutil, sys\n"
        "project, options = pathlib.Path(sys.argv[1]), sys.argv[2:]\n"
        "assert '--keep-crs' in options and '--cpu' in options and options[options.index('-d') + 1] == '1'\n"
        "assert all((project / f'{n}.bin').exists() for n in ('cameras', 'images', 'points3D'))\n"
        "(project / 'asked').open('a').write(options[options.index('-n') + 1] + '\\n')\n"
        f"if options[options.index('-n') + 1] == '{fails_at}': sys.exit('out of splats')\n"
        f"shutil.copy({str(result)!r}, options[options.index('-o') + 1])\n"
    )
    file.chmod(file.stat().st_mode | stat.S_IXUSR)
    return file


def test_opensplat_gets_the_frames_that_are_not_held_out_and_its_map_is_scored_on_the_others(tmp_path: Path) -> None:
    ours = six_frames()
    poses = np.tile(np.eye(4), (5, 1, 1))
    model = Model(np.array([0, 1, 3, 4, 5]), poses, np.zeros((7, 3)), np.zeros((7, 3), np.uint8), {}, 20.0)
    a_map(tmp_path / "wall.ply", 200 / 255)  # as bright as the held-out frame
    binary = stand_in(tmp_path / "opensplat", tmp_path / "wall.ply")
    project = tmp_path / "project"
    results = opensplat.train(binary, ours, model, project, 1)
    written = {file.stem for file in (project / "images").iterdir()}
    assert written == {f"{i:06d}" for i in (0, 1, 3, 4)}  # 2 has no pose, 5 is scored
    assert struct.unpack("<Q", (project / "points3D.bin").read_bytes()[:8]) == (7,)
    asked = [int(line) for line in (project / "asked").read_text().split()]
    assert asked == [opensplat.PROBE, *(times * asked[1] for times in (1, 4, 16))]
    assert asked[1] >= opensplat.PROBE
    assert all(result.psnr > 40.0 for result in results)
    assert [result.iterations for result in results] == asked[1:]
    rows = by_name(baselines.opensplat_rows("room", binary, ours, model, project))
    assert rows["room: map, COLMAP + OpenSplat, 4 times the iterations: splats"].value == results[0].splats
    assert not rows["room: ours minus OpenSplat, equal time"].met  # 25 dB against a perfect wall
    assert baselines.opensplat_rows("room", None, ours, model, project) == []


def test_an_opensplat_that_fails_is_a_row_and_not_the_end(tmp_path: Path) -> None:
    ours, model = six_frames(), Model(np.array([0, 5]), np.tile(np.eye(4), (2, 1, 1)), np.zeros((7, 3)),
                                      np.zeros((7, 3), np.uint8), {}, 20.0)  # fmt: skip
    binary = stand_in(tmp_path / "opensplat", tmp_path / "none.ply", opensplat.PROBE)
    rows = baselines.opensplat_rows("room", binary, ours, model, tmp_path / "project")
    assert [(row.met, "code 1: out of splats" in str(row.value)) for row in rows] == [(False, True)]
    missing = baselines.opensplat_rows("room", tmp_path / "no binary", ours, model, tmp_path / "project")
    assert [row.met for row in missing] == [False]


def test_the_written_model_is_what_colmap_reads(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    ours = six_frames()
    pose = np.array(ours.frames[3].world_from_cam)
    points = np.array([[1.0, 2, 3], [4, 5, 6]])
    model = Model(np.array([3]), pose[None], points, np.array([[1, 2, 3], [4, 5, 6]], np.uint8), {}, 1.0)
    opensplat.write_project(tmp_path, ours, model, [3])
    read = pycolmap.Reconstruction(str(tmp_path))
    image = next(iter(read.images.values()))
    assert image.name == "000003.png"
    assert np.allclose(image.cam_from_world().inverse().matrix(), pose[:3])
    assert next(iter(read.cameras.values())).params.tolist() == [9.0, 9.0, 5.5, 3.5]
    assert sorted(p.xyz.tolist() for p in read.points3D.values()) == points.tolist()


def test_each_method_is_a_series_of_its_own_in_the_plot() -> None:
    others = [
        f"COLMAP + {what}" for what in ("splatting, equal time", "splatting, 2 times as long", "OpenSplat, equal time")
    ]
    methods = ["ours", *others]
    drawn = [
        {"name": f"room: map, {method}: {figure}", "value": value + k}
        for k, method in enumerate(methods)
        for figure, value in (("held-out PSNR", 25.0), ("seconds, frames to map", 10.0))
    ]
    rows = {"baselines": drawn, "tracking": [{"name": "room: ATE / pycolmap's, same frames", "value": 0.9}]}
    plot = figures.plots_of(lambda name: rows[name])["maps"]
    for series in ("room, ours", "room, COLMAP + splatting", "room, COLMAP + OpenSplat"):
        assert plot.count(f">{series}<") == 1
