"""The second half of a sequence on the map of its first half: `python -m bench.known_map`.

The tracker: how soon the camera is found, how far its poses and the first half's are from the truth, together, against
those of one run over both halves; the same with a frozen map, whose frame of reference is the first half's alone. Other
ways back and other light. Frames of other scenes, each on its own, must be found in no map. Whole runs: held-out frames
of the second half, rendered from the extended map and from the map of one run over both.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.runs import DATA
from bench.table import Row, all_of, at_least, at_most, main
from bench.tracking.cases import CASES, Case
from launch.compose import compose
from launch.inline import run_inline
from mvsgs_core import geometry
from mvsgs_core.datasets import Item
from mvsgs_core.kept_map import STREAM, tracker_file
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.known_map import KnownMap, load
from mvsgs_core.tracking.tracker import Tracker

LOOP = {"frames": 300, "loop": True, "threads": 1}
DARKER = 0.6  # of the gray levels


@dataclass(frozen=True)
class Return:
    """Two halves of a sequence, in the order in which they are seen."""

    first: list[Item]
    second: list[Item]

    @property
    def both(self) -> list[Item]:
        """One stream of both, a frame's time between them."""
        return numbered([*self.first, *self.second], self.step)

    @property
    def step(self) -> float:
        """Seconds between frames, the median."""
        return float(np.median(np.diff([item.timestamp for item in self.first])))


def numbered(items: Sequence[Item], step: float) -> list[Item]:
    """As a stream of their own."""
    return [replace(item, index=n, timestamp=n * step) for n, item in enumerate(items)]


def halves(items: Sequence[Item]) -> Return:
    half = len(items) // 10 * 5  # a frame that is held out in one is in the other
    step = float(np.median(np.diff([item.timestamp for item in items])))
    return Return(numbered(items[:half], step), numbered(items[half:], step))


def backward(way: Return) -> Return:
    return Return(way.first, numbered(way.second[::-1], way.step))


def in_light(way: Return, second: Sequence[Item]) -> Return:
    return Return(way.first, numbered(second, way.step))


def returns(quick: bool) -> dict[str, Return]:
    """By name; those whose data are here."""
    if quick:
        return {"room": backward(halves(Case("synthetic", {"frames": 80, "threads": 1}).items()))}
    found: dict[str, Return] = {}
    for name, case in {"redkitchen": "redkitchen, color camera 525", "tum_fr1_xyz": "tum_fr1_xyz"}.items():
        if CASES[case].there:
            way = halves(CASES[case].items())
            darker = [replace(i, image=(DARKER * i.image).astype(np.uint8)) for i in way.second]
            found |= {name: way, f"{name}, backward, darker": backward(in_light(way, darker))}
    loop = halves(Case("synthetic", LOOP).items())
    varying = halves(Case("synthetic", {**LOOP, "exposure": 1.0}).items())
    other = in_light(loop, varying.second)
    return found | {"room, loop": loop, "room, loop, backward, varying exposure": backward(other)}


def tracked(items: Sequence[Item], known: KnownMap | None = None, frozen: bool = False) -> tuple[Tracker, int | None]:
    """And the first frame that was found in the map that was known."""
    tracker, found = Tracker(clock=time.process_time, known=known, frozen=frozen), None
    for item in items:
        tracker.add(item.index, item.timestamp, item.image, item.intrinsics, item.intrinsics_guessed)
        pose = tracker.newest_pose()
        if known is not None and found is None and pose is not None and pose.segment in known.segments:
            found = item.index
    for _ in tracker.finish():
        pass
    return tracker, found


def positions(tracker: Tracker, items: Sequence[Item], before: Sequence[Item]) -> tuple[np.ndarray, np.ndarray, int]:
    """Of the map's keyframes from `before`, then of the frames of `items`: estimates and truths (N, 3), and how many
    are the map's. Frames of other parts of the map, and those without a truth, are left out."""
    path, graph = tracker.trajectory(), tracker.session.graph
    old = [k for k in sorted(graph.keyframes) if k < 0 and before[k + STREAM].world_from_cam is not None]
    new = [int(k) for k in np.flatnonzero(path.main()) if items[int(path.index[k])].world_from_cam is not None]
    estimates = [graph.world_from_cam(k) for k in old] + [path.world_from_cam[k] for k in new]
    truths = [before[k + STREAM].world_from_cam for k in old]
    truths += [items[int(path.index[k])].world_from_cam for k in new]
    return np.stack(estimates)[:, :3, 3], np.stack([np.asarray(t) for t in truths])[:, :3, 3], len(old)


def errors(estimates: np.ndarray, truths: np.ndarray, aligned_by: slice) -> np.ndarray:
    """(N,) distances, aligned by some of them."""
    s, r, t = geometry.umeyama(estimates[aligned_by], truths[aligned_by])
    return np.asarray(np.linalg.norm(s * estimates @ r.T + t - truths, axis=1))


def rows_of_tracking(name: str, way: Return, folder: Path) -> tuple[list[Row], KnownMap]:
    file, everything = folder / "tracker.npz", slice(None)
    tracked(way.first)[0].keep_map(file)
    known = load(file)
    tracker, found = tracked(way.second, known.renumbered(STREAM))
    estimates, truths, old = positions(tracker, way.second, way.first)
    together = 100.0 * float(np.median(errors(estimates, truths, everything)[old:]))
    one = tracked(way.both)[0]
    estimates, truths, _ = positions(one, way.both, ())
    second = one.trajectory().index[one.trajectory().main()] >= len(way.first)
    second = second[[way.both[k].world_from_cam is not None for k in one.trajectory().index[one.trajectory().main()]]]
    alone = 100.0 * float(np.median(errors(estimates, truths, everything)[second]))
    frozen, _ = tracked(way.second, known.renumbered(STREAM), frozen=True)
    estimates, truths, old = positions(frozen, way.second, way.first)
    off = 100.0 * errors(estimates, truths, slice(old))[old:]
    path, posed = tracker.trajectory(), int(frozen.trajectory().posed.sum())
    count = len(way.second)
    seconds = np.inf if found is None else found * way.step
    cost = 1e3 * tracker.stats.seconds["taking up the map"]
    return [
        at_most(f"{name}: the camera is found after", seconds, "s of video", 1.0),
        all_of(f"{name}: frames posed in the map's frame of reference", int(path.main().sum()), count),
        Row(f"{name}: error of one run over both, second half, median", alone, "cm"),
        at_most(f"{name}: error on the map, over that", together / alone, "", 1.5),
        Row(f"{name}: frozen: frames found", f"{posed} of {count}"),
        Row(f"{name}: frozen: error in the first half's frame, median", float(np.median(off)), "cm"),
        Row(f"{name}: the tracker's half, {len(known.keyframes)} keyframes", 1e-6 * file.stat().st_size, "MB"),
        Row(f"{name}: taking it up", cost, "ms CPU"),
    ], known


def false_finds(known: KnownMap, own: Item, strangers: Sequence[Item]) -> int:
    """How many frames of other scenes are found in a map, each looked for on its own. own: a frame of the map's."""
    tracker = Tracker(known=known.renumbered(STREAM), frozen=True)
    session = tracker.begin((own.image.shape[0], own.image.shape[1]), own.intrinsics)
    found = 0
    for item in strangers:
        image = TrackingImage.of(item.index, item.timestamp, item.image, session.size, False)
        found += session.relocalizer.relocalize(image) is not None
    return found


def rows_of_strangers(known: dict[str, KnownMap], ways: dict[str, Return], wanted: int | None) -> list[Row]:
    """Every map against the frames of every other scene."""
    tried = found = 0
    for name, one in known.items():
        scene = name.partition(",")[0]
        others = {n.partition(",")[0]: way for n, way in ways.items() if n.partition(",")[0] != scene}
        strangers = [item for way in others.values() for item in (*way.first, *way.second)]
        if not others:
            strangers = Case("synthetic", {"scene": "aerial", "frames": wanted or 120, "threads": 1}).items()
        tried += len(strangers)
        found += false_finds(one, ways[name].first[0], strangers)
    return [at_most(f"{tried:,} frames of other scenes: found in a map all the same", float(found), "", 0.0)]


@dataclass(frozen=True)
class Scene:
    """For whole runs."""

    words: tuple[str, ...]  # overrides
    half: int  # frames
    on_return: tuple[str, ...] = ()  # overrides of the second half's
    folder: str = ""  # below ../shared/data

    @property
    def there(self) -> bool:
        return not self.folder or (DATA / self.folder).is_dir()


KITCHEN, TUM = "seven_scenes_redkitchen", "tum_fr1_xyz"
SCENES = {
    "redkitchen": Scene(("dataset=seven_scenes", f"dataset.path={DATA / KITCHEN}"), 150, folder=KITCHEN),
    "tum_fr1_xyz": Scene(("dataset=tum", f"dataset.path={DATA / TUM}"), 80, folder=TUM),
    "room, loop": Scene(("dataset.options.frames=300", "dataset.options.loop=true"), 150),
    "room, loop, varying exposure": Scene(
        ("dataset.options.frames=300", "dataset.options.loop=true"), 150, ("dataset.options.exposure=1.0",)
    ),
}
QUICK = {"room": Scene(("dataset.options.frames=80", "dataset.size=[120,160]", "mapper.iterations=8"), 40)}
EACH = ("device=cpu", "evaluator.fitted=false", "evaluator.max_frames=1000", "mapper.checkpoint=0", "screen=off")


def held_out(words: Sequence[str], output: Path, first: int) -> dict[int, float]:
    """PSNR of a run's held-out frames, by their index from that frame on."""
    run_inline(compose([*EACH, *words, f"output={output}"]))
    report: dict[str, Any] = json.loads((output / "report.json").read_text())
    frames = report["rendering"]["frames"]
    return {frame["index"] - first: frame["psnr"] for frame in frames if frame["held_out"] and frame["index"] >= first}


def rows_of_map(name: str, scene: Scene, folder: Path) -> list[Row]:
    small = ("dataset.size=[240,320]",) if scene.folder else ()
    words, start, stop = [*scene.words, *small], f"dataset.start={scene.half}", f"dataset.stop={scene.half}"
    held_out([*words, stop, "keep_map=true"], folder / "first", 0)
    extended = held_out([*words, start, *scene.on_return, f"map={folder / 'first'}"], folder / "second", 0)
    rows = []
    if not scene.on_return:
        one = held_out(words, folder / "both", scene.half)
        same = sorted(extended.keys() & one.keys())
        gain = float(np.mean([extended[k] - one[k] for k in same]))
        rows = [at_least(f"{name}: held-out PSNR of the second half over that of one run over both", gain, "dB", -0.3)]
    mean = float(np.mean(list(extended.values())))
    size = sum(f.stat().st_size for f in tracker_file(folder / "second").parent.rglob("*") if f.is_file())
    return [
        Row(f"{name}: held-out PSNR of the second half, extended map", mean, "dB"),
        *rows,
        Row(f"{name}: the extended map as it is kept", 1e-6 * size, "MB"),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    rows: list[Row] = []
    ways, known = returns(options.quick), {}
    for name, way in ways.items():
        with tempfile.TemporaryDirectory() as folder:
            found, known[name] = rows_of_tracking(name, way, Path(folder))
            rows += found
    rows += rows_of_strangers(known, ways, 60 if options.quick else None)
    if options.part != "tracker":
        for name, scene in (QUICK if options.quick else SCENES).items():
            if scene.there:
                with tempfile.TemporaryDirectory() as folder:
                    rows += rows_of_map(name, scene, Path(folder))
    return rows


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--part", choices=("all", "tracker"), default="all", help="tracker: no whole runs")


if __name__ == "__main__":
    main(measure, "A map that is known", arguments)
