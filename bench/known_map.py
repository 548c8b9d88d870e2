"""The second half of a sequence on the map of its first half: `python -m bench.known_map`.

The tracker: how soon the camera is found, how far its poses and the first half's are from the truth, together, against
those of one run over both halves; the same with a frozen map, whose frame of reference is the first half's alone. Other
ways back and other light. Frames of other scenes, each on its own, must be found in no map. Whole runs: held-out frames
of the second half, rendered from the extended map and from the map of one run over both, forward, and backward in other
light. `--resume` takes what an earlier, interrupted call has finished from the output's folder.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.aligned import distances
from bench.live.recordings import write
from bench.pieces import Kept, kept_arguments
from bench.runs import folder, folder_name, held_out_scores
from bench.table import Row, all_of, at_least, at_most, main, names
from bench.tracking.cases import CASES, Case, missing
from bench.tracking.track import track
from launch.compose import compose
from launch.inline import run_inline
from msgs import Frame, GroundTruth
from mvsgs_core.datasets import Item
from mvsgs_core.kept_map import STREAM, tracker_file
from mvsgs_core.tracking.image import TrackingImage
from mvsgs_core.tracking.known_map import KnownMap, load
from mvsgs_core.tracking.tracker import Tracker

SMALL = [240, 320]  # height, width of the whole runs' frames
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


def darker(way: Return) -> Return:
    """The second half is dark."""
    return Return(way.first, [replace(i, image=(DARKER * i.image).astype(np.uint8)) for i in way.second])


@dataclass(frozen=True)
class Scene:
    """The same place twice: the second half as it was, and seen backward in other light."""

    light: str  # what the other light is
    plain: Case
    other: Case | None = None  # the frames in other light; None: they are made darker

    def returns(self, name: str, size: Sequence[int] | None = None) -> dict[str, Return]:
        """By name. size: (height, width) of the frames; None: their own."""
        way = halves(_of_size(self.plain, size).items())
        other = (
            darker(way) if self.other is None else Return(way.first, halves(_of_size(self.other, size).items()).second)
        )
        return {name: way, f"{name}, backward, {self.light}": backward(other)}


def _of_size(case: Case, size: Sequence[int] | None) -> Case:
    return case if size is None else replace(case, options={**case.options, "size": list(size)})


SCENES = {
    "redkitchen": Scene("darker", CASES["redkitchen, color camera 525"]),
    "tum_fr1_xyz": Scene("darker", CASES["tum_fr1_xyz"]),
    "room, loop": Scene("varying exposure", Case("synthetic", LOOP), Case("synthetic", {**LOOP, "exposure": 1.0})),
}
QUICK = {"room": Scene("darker", Case("synthetic", {"frames": 80, "threads": 1}))}


def scenes(options: argparse.Namespace) -> dict[str, Scene]:
    """Those whose data are here."""
    return QUICK if options.quick else {name: scene for name, scene in SCENES.items() if scene.plain.there}


def tracked(items: Sequence[Item], known: KnownMap | None = None, frozen: bool = False) -> tuple[Tracker, int | None]:
    """And the first frame that was found in the map that was known."""
    tracker, found = Tracker(clock=time.process_time, known=known, frozen=frozen), list[int]()

    def look(item: Item) -> None:
        pose = tracker.newest_pose()
        if known is not None and not found and pose is not None and pose.segment in known.segments:
            found.append(item.index)

    track(items, tracker, look)
    return tracker, next(iter(found), None)


def positions(tracker: Tracker, first: int = 0) -> dict[int, np.ndarray]:
    """(3,) by the frame's number in one stream of both halves: keyframes of the map that was known, then the frames of
    this run that are in its largest part. first: how many frames come before the first of this run."""
    path, graph = tracker.trajectory(), tracker.session.graph
    known = {k + STREAM: graph.world_from_cam(k)[:3, 3] for k in sorted(graph.keyframes) if k < 0}
    return known | {first + int(path.index[k]): path.world_from_cam[k, :3, 3] for k in np.flatnonzero(path.main())}


def errors(
    found: dict[int, np.ndarray], truths: dict[int, np.ndarray], chosen: Sequence[int], by: Sequence[int]
) -> np.ndarray:
    """(N,) distances of the chosen frames from the truth, after alignment by others."""
    together = [*by, *chosen]
    estimates, wanted = (np.stack([known[k] for k in together]) for known in (found, truths))
    return distances(estimates, wanted, slice(len(by)))[len(by) :]


def compared(
    extended: dict[int, np.ndarray], one: dict[int, np.ndarray], truths: dict[int, np.ndarray], first: int
) -> tuple[float, float]:
    """Median errors of the second half on the known map and in one run over both: of the same frames, after alignment
    by the same ones, which are all that both have and whose truth is known."""
    common = sorted(extended.keys() & one.keys() & truths.keys())
    second = [k for k in common if k >= first]
    on_map, alone = (float(np.median(errors(found, truths, second, common))) for found in (extended, one))
    return on_map, alone


def rows_of_tracking(name: str, way: Return, file: Path) -> list[Row]:
    """file: the first half's map."""
    known, first, count = load(file), len(way.first), len(way.second)
    truths = {item.index: item.world_from_cam[:3, 3] for item in way.both if item.world_from_cam is not None}
    tracker, found = tracked(way.second, known.renumbered(STREAM))
    on_map, alone = compared(positions(tracker, first), positions(tracked(way.both)[0]), truths, first)
    frozen, _ = tracked(way.second, known.renumbered(STREAM), frozen=True)
    there = positions(frozen, first)
    old, new = ([k for k in there if k in truths and (k >= first) == late] for late in (False, True))
    off = 100.0 * float(np.median(errors(there, truths, new, old)))
    path, posed = tracker.trajectory(), int(frozen.trajectory().posed.sum())
    seconds = np.inf if found is None else found * way.step
    cost = 1e3 * tracker.stats.seconds["taking up the map"]
    return [
        at_most(f"{name}: the camera is found after", seconds, "s of video", 1.0),
        all_of(f"{name}: frames posed in the map's frame of reference", int(path.main().sum()), count),
        Row(f"{name}: error of one run over both, second half, median", 100.0 * alone, "cm"),
        at_most(f"{name}: error on the map, over that", on_map / alone, "", 1.5),
        Row(f"{name}: frozen: frames found", f"{posed} of {count}"),
        Row(f"{name}: frozen: error in the first half's frame, median", off, "cm"),
        Row(f"{name}: the tracker's half, {len(known.keyframes)} keyframes", 1e-6 * file.stat().st_size, "MB"),
        Row(f"{name}: taking it up", cost, "ms CPU"),
    ]


def false_finds(known: KnownMap, own: Item, strangers: Sequence[Item]) -> int:
    """How many frames of other scenes are found in a map, each looked for on its own. own: a frame of the map's."""
    tracker = Tracker(known=known.renumbered(STREAM), frozen=True)
    session = tracker.begin((own.image.shape[0], own.image.shape[1]), own.intrinsics)
    found = 0
    for item in strangers:
        image = TrackingImage.of(item.index, item.timestamp, item.image, session.size, False)
        found += session.relocalizer.relocalize(image) is not None
    return found


def rows_of_strangers(known: dict[str, KnownMap], ways: dict[str, Return]) -> list[Row]:
    """The map of every scene against the frames of every other one."""
    tried = found = 0
    for name, one in known.items():
        strangers = [item for n, way in ways.items() if n != name for item in (*way.first, *way.second)]
        if not strangers:
            strangers = Case("synthetic", {"scene": "aerial", "frames": 60, "threads": 1}).items()
        tried += len(strangers)
        found += false_finds(one, ways[name].first[0], strangers)
    return [at_most(f"{tried:,} frames of other scenes: found in a map all the same", float(found), "", 0.0)]


EACH = (
    "dataset=player", "device=cpu", "evaluator.fitted=false", "evaluator.max_frames=1000", "mapper.checkpoint=0",
    "screen=off",
)  # fmt: skip
QUICKLY = ("mapper.iterations=8",)


def messages(items: Sequence[Item]) -> Iterator[Frame | GroundTruth]:
    """A stream of them for whole runs."""
    for i in items:
        yield Frame(i.index, i.timestamp, i.image, i.intrinsics, i.intrinsics_guessed, i.exposure)
        yield GroundTruth(i.index, i.timestamp, i.image, i.intrinsics, i.world_from_cam, i.depth)


def held_out(words: Sequence[str], items: Sequence[Item], output: Path, first: int, kept: Kept) -> dict[int, float]:
    """PSNR of a run's held-out frames, by their index from that frame on; of a run that is kept, where it is one of the
    same images."""
    file, given = output / "report.json", [*EACH, *words]
    asked = {"overrides": given, "images": identity(items)}
    if not kept.has(file, asked):
        shutil.rmtree(output, ignore_errors=True)
        stream = write(messages(items), output.with_suffix(".mcap"))
        run_inline(compose([*given, f"dataset.path={stream}", f"output={output}"]))
        if not json.loads(file.read_text()).get("finished", True):
            raise RuntimeError(f"the run in {output} ended early: see its report.json")
        kept.keep(file, asked)
    report: dict[str, Any] = json.loads(file.read_text())
    return {index - first: psnr for index, psnr in held_out_scores(report).items() if index >= first}


def rows_of_map(name: str, way: Return, first: Path, place: Path, options: argparse.Namespace, kept: Kept) -> list[Row]:
    """first: of the run over the first half, which ways back share; place: of the others."""
    words = QUICKLY if options.quick else ()
    held_out([*words, "keep_map=true"], way.first, first, 0, kept)
    extended = held_out([*words, f"map={first}"], way.second, place / "second", 0, kept)
    one = held_out(words, way.both, place / "both", len(way.first), kept)
    same = sorted(extended.keys() & one.keys())
    gain = float(np.mean([extended[k] - one[k] for k in same]))
    mean = float(np.mean(list(extended.values())))
    size = sum(f.stat().st_size for f in tracker_file(place / "second").parent.rglob("*") if f.is_file())
    return [
        Row(f"{name}: held-out PSNR of the second half, extended map", mean, "dB"),
        at_least(f"{name}: held-out PSNR of the second half over that of one run over both", gain, "dB", -0.3),
        Row(f"{name}: the extended map as it is kept", 1e-6 * size, "MB"),
    ]


def identity(items: Sequence[Item]) -> str:
    """Of the same images, taken at the same times."""
    digest = hashlib.sha256()
    for item in items:
        digest.update(np.float64(item.timestamp).tobytes() + item.intrinsics.tobytes() + item.image.tobytes())
    return digest.hexdigest()


def mapped(options: argparse.Namespace) -> dict[str, Scene]:
    """Those of which there are whole runs."""
    there = scenes(options)
    wanted = there if options.quick or options.maps is None else options.maps
    return {name: there[name] for name in wanted if name in there} if options.part != "tracker" else {}


def parts(options: argparse.Namespace, place: Path) -> Iterator[list[Row]]:
    known: dict[str, KnownMap] = {}
    plain: dict[str, Return] = {}
    kept, seen = Kept(options.resume), dict[str, str]()
    for scene, given in scenes(options).items():
        ways, file = given.returns(scene), place / f"{folder_name(scene)}.npz"
        seen[scene] = identity(ways[scene].both)
        if not kept.has(file, seen[scene]):
            tracked(ways[scene].first)[0].keep_map(file)
            kept.keep(file, seen[scene])
        for name, way in ways.items():
            measured = partial(rows_of_tracking, name, way, file)
            yield kept.rows(place / f"{folder_name(name)}.json", identity(way.both), measured)
        known[scene], plain[scene] = load(file), ways[scene]
    yield kept.rows(place / "strangers.json", seen, partial(rows_of_strangers, known, plain))
    for scene, given in mapped(options).items():
        for name, way in given.returns(scene, [120, 160] if options.quick else SMALL).items():
            runs = place / folder_name(name)
            runs.mkdir(exist_ok=True)
            yield rows_of_map(name, way, place / f"{folder_name(scene)}-first", runs, options, kept)
    yield [] if options.quick else missing({name: scene.plain for name, scene in SCENES.items()})
    yield kept.origin()


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    return [row for rows in parts(options, folder(options, "known_map")) for row in rows]


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--part", choices=("all", "tracker"), default="all", help="tracker: no whole runs")
    told = f"scenes of which there are whole runs, separated by semicolons, of {'; '.join(SCENES)}; default: all"
    parser.add_argument("--maps", type=names(SCENES, ";"), help=told)
    kept_arguments(parser)


if __name__ == "__main__":
    main(measure, "A map that is known", arguments)
