"""A camera that goes away five times and comes back elsewhere: `python -m bench.lost`.

A sequence is cut into six pieces. A robot's program sends them over the network in another order, so that the camera
returns to a place that it has left or to one that it has never seen; the frames around each cut are gone. In between
the program ends, and one that starts anew has its own sequence numbers and perhaps its own clock, or it is silent. The
source of a run (`dataset=robot`) reads it and the tracker tracks, as they do in any run; a frame is sent when the one
before was taken. Compared with the whole sequence in one stream.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from bench.aligned import distances
from bench.table import Row, all_of, at_least, at_most, main, names
from bench.tracking.cases import CASES, Case, missing
from bench.tracking.track import track
from launch.compose import compose
from launch.inline import run_inline
from launch.ports import free_ports
from msgs import CameraPose, End, Frame, GroundTruth, Keyframe, Poses, Trajectory
from mvsgs_core.datasets import Item
from mvsgs_core.trajectory import Trajectory as CameraTrajectory
from nodes.runtime.transport import LivePublisher

ORDER = (0, 3, 1, 5, 2, 4)  # the pieces as they are shown: 3 and 5 show places that were never seen
AWAY = (1.0, 10.0, 2.5, 5.0, 3.0)  # s, for which the camera is away before each piece but the first
GONE = 1 / 3  # s of the sequence that no piece shows, at each cut
WAYS = ("ended", "silent", "ended, clock anew", "silent", "ended")  # what befell the program
SCENES = {
    "redkitchen": CASES["redkitchen, color camera 525"],
    "tum_fr1_xyz": CASES["tum_fr1_xyz"],
    "room, loop": CASES["room, loop"],
}
QUICK = {"room": Case("synthetic", {"frames": 120, "threads": 1})}
QUICK_AWAY = (1.0, 2.5, 1.0, 2.5, 1.0)
OFF = ("mvs", "depth_fusion", "mapper", "evaluator")
NO_FRAME = b"N" + bytes(range(256))
REFUSALS = {"no frame": "refused", "doubled": "doubled"}  # what is sent besides, as the source counts it
PATIENCE = 60.0  # s until a reader has come or a frame was taken, at most


@dataclass(frozen=True)
class Piece:
    """What the camera shows from one return to the next loss."""

    items: list[Item]
    away: float = 0.0  # s before it
    way: str = ""  # how the camera was lost before it


def pieces(items: Sequence[Item], away: Sequence[float]) -> list[Piece]:
    """In the order in which they are shown."""
    bounds = np.linspace(0, len(items), len(ORDER) + 1).astype(int)
    gone = round(GONE / step(items))
    cut = [list(items[a : b - (gone if b < len(items) else 0)]) for a, b in itertools.pairwise(bounds)]
    after = [Piece(cut[k], s, way) for k, s, way in zip(ORDER[1:], away, WAYS, strict=True)]
    return [Piece(cut[ORDER[0]]), *after]


def step(items: Sequence[Item]) -> float:
    """Seconds between frames, the median."""
    return float(np.median(np.diff([item.timestamp for item in items])))


@dataclass
class Program:
    """Sends the pieces; one frame more whenever one was `taken`. What it sends besides must be refused."""

    address: str
    shown: list[Piece]
    interval: float  # s between frames
    taken: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    counts: Mapping[str, float] = field(default_factory=dict)  # of the source that reads, once a frame came
    back: list[float] = field(default_factory=list)  # s from each return to the first frame that was taken
    sent: Counter[str] = field(default_factory=Counter)
    error: Exception | None = None

    def start(self) -> threading.Thread:
        thread = threading.Thread(target=self._run, name="program", daemon=True)
        thread.start()
        return thread

    def _run(self) -> None:
        try:
            self._send()
        except Exception as error:
            self.error = error

    def _send(self) -> None:
        publisher, last, now = self._publisher(), None, 0.0
        for piece in self.shown:
            if piece.way.startswith("ended"):
                publisher.close(farewell=False)
            time.sleep(piece.away)
            now = 0.0 if "anew" in piece.way else now + piece.away
            returned = time.monotonic()
            if piece.way.startswith("ended"):
                publisher = self._publisher()
                publisher.socket.send(NO_FRAME)
                self._count("no frame")
            elif last is not None:  # as drivers do: the last picture that it had
                publisher.send(last)
                self._count("doubled")
            for n, item in enumerate(piece.items):
                last = Frame(0, now, item.image, item.intrinsics, item.intrinsics_guessed)
                publisher.send(last)
                self._count("frames")
                if n == 0 and piece.way:
                    self.back.append(time.monotonic() - returned)
                now += self.interval
        publisher.send(End())
        publisher.close(farewell=False)

    def _publisher(self) -> LivePublisher:
        """A program anew, with a reader."""
        publisher, until = LivePublisher(self.address), time.monotonic() + PATIENCE
        while not publisher.ready(1):
            if time.monotonic() > until:
                raise TimeoutError("no reader came")
            time.sleep(0.01)
        return publisher

    def _count(self, what: str) -> None:
        """It was sent; returns as soon as it was received."""
        self.sent[what] += 1
        until = time.monotonic() + PATIENCE
        while not (self.taken.acquire(timeout=0.01) if what == "frames" else self._refused()):
            if time.monotonic() > until:
                raise TimeoutError(f"{what}: nobody takes them")

    def _refused(self) -> bool:
        """Whether the source has refused all that it should."""
        time.sleep(0.01)
        return all(self.counts.get(count, 0) >= self.sent[what] for what, count in REFUSALS.items())


@dataclass
class Seen:
    """What a run told, by the number of a frame in the stream."""

    poses: dict[int, int] = field(default_factory=dict)  # part of the map that it was found in as it came
    keyframes: dict[int, int] = field(default_factory=dict)  # part of the map, as it is by now
    joined: dict[int, int] = field(default_factory=dict)  # of a keyframe: the frame at which it was in the first part
    newest: int = 0
    trajectory: CameraTrajectory = field(default_factory=CameraTrajectory.empty)

    def note(self, message: Any) -> None:
        if isinstance(message, Frame):
            self.newest = message.index
        elif isinstance(message, CameraPose):
            self.poses[message.index] = message.segment
        elif isinstance(message, Keyframe):
            self._place(message.index, message.segment)
        elif isinstance(message, Poses) and message.segment is not None:
            for index, segment in zip(message.index.tolist(), message.segment.tolist(), strict=True):
                self._place(index, segment)
        elif isinstance(message, Trajectory):
            self.trajectory = CameraTrajectory(**vars(message))

    def _place(self, index: int, segment: int) -> None:
        self.keyframes[index] = segment
        if segment == self.keyframes[min(self.keyframes)]:
            self.joined.setdefault(index, self.newest)


def run(shown: list[Piece], interval: float) -> tuple[Program, Seen, dict[str, float]]:
    """The program, what the tracker told, and what the source counted."""
    program, seen = Program(f"tcp://127.0.0.1:{free_ports(1)[0]}", shown, interval), Seen()

    def observe(slot: str, node: Any, message: Any) -> None:
        seen.note(message)
        if isinstance(message, GroundTruth):
            program.counts = node.stats.counts
            program.taken.release()

    with tempfile.TemporaryDirectory() as folder:
        off = [f"{slot}._target_=null" for slot in OFF]
        source = ["dataset=robot", f"dataset.path={program.address}"]
        graph = compose([*source, "device=cpu", "tracker.threads=1", f"output={folder}", *off])
        thread = program.start()
        try:
            found = run_inline(graph, observe)["dataset"]
        finally:
            thread.join(10.0)
            if program.error is not None:
                raise program.error
    return program, seen, dict(found.stats.counts)


def of_returns(shown: Sequence[Piece]) -> list[range]:
    """The frames of each piece but the first, as they are numbered in the stream."""
    ends = np.cumsum([len(piece.items) for piece in shown]).tolist()
    return [range(a, b) for a, b in itertools.pairwise(ends)]


def found_after(seen: Seen, frames: range) -> int | None:
    """How many frames after a return the camera was found in a part of the map that was there before; None: never."""
    before = {part for index, part in seen.poses.items() if index < frames.start}
    return next((i - frames.start for i in frames if seen.poses.get(i) in before), None)


def joined_after(seen: Seen, frames: range) -> int | None:
    """How many frames after a return a keyframe of it was in the first part of the map; None: never."""
    return min((seen.joined[i] - frames.start for i in frames if i in seen.joined), default=None)


def medians(items: Sequence[Item], seen: Seen, shown: Sequence[Piece]) -> tuple[float, float]:
    """Errors of the frames after the returns, in centimeters: in one stream of the whole sequence, and of this run."""
    unknown = np.full((4, 4), np.nan)
    truths = np.stack([unknown if i.world_from_cam is None else i.world_from_cam for i in items])[:, :3, 3]
    order = np.array([item.index for piece in shown for item in piece.items])
    after = of_returns(shown)[0].start
    alone = by_frame(track(items).tracker.trajectory(), truths)
    here = by_frame(seen.trajectory, truths[order])
    return (
        100.0 * float(np.median([alone[n] for n in order[after:] if n in alone])),
        100.0 * float(np.median([error for n, error in here.items() if n >= after] or [np.inf])),
    )


def by_frame(path: CameraTrajectory, truths: np.ndarray) -> dict[int, float]:
    """Distances from the truths (N, 3), of the frames of the map that have one, aligned by all of these."""
    there = np.flatnonzero(path.main() & np.isfinite(truths).all(axis=1))
    return dict(zip(there.tolist(), distances(path.world_from_cam[there, :3, 3], truths[there]).tolist(), strict=True))


def rows_of_returns(name: str, seen: Seen, returns: Sequence[range], interval: float) -> list[Row]:
    """interval: seconds of the sequence between frames."""
    main_part = seen.trajectory.main()
    there = [frames for frames in returns if main_part[frames.start : frames.stop].any()]
    found = [found_after(seen, frames) for frames in there]
    at_once = [frames for frames in found if frames is not None]
    later = [joined_after(seen, frames) for frames, when in zip(there, found, strict=True) if when is None]
    joined = [frames for frames in later if frames is not None]
    return [
        all_of(f"{name}: returns that are part of the map in the end", len(there), len(returns)),
        Row(f"{name}: of these relocalized as they came", len(at_once)),
        at_most(f"{name}: relocalized after, worst", max(at_once, default=np.inf) * interval, "s of video", 1.0),
        Row(f"{name}: parts that joined later", len(joined)),
        Row(f"{name}: joined after, worst", max(joined, default=0) * interval, "s of video"),
    ]


def rows_of(name: str, case: Case, away: Sequence[float]) -> list[Row]:
    items = numbered(case.items())
    shown, interval = pieces(items, away), step(items)
    program, seen, counts = run(shown, interval)
    returns = of_returns(shown)
    main_part = seen.trajectory.main()
    after = returns[0].start
    alone, error = medians(items, seen, shown)
    refused = sum(program.sent[what] for what in REFUSALS)
    return [
        all_of(f"{name}: losses that the source counted", int(counts.get("lost", 0)), len(returns)),
        all_of(f"{name}: frames that it took", int(counts.get("frames", 0)), program.sent["frames"]),
        all_of(
            f"{name}: what is no new frame, refused", int(sum(counts.get(c, 0) for c in REFUSALS.values())), refused
        ),
        Row(f"{name}: from the camera's return to its first frame, worst", max(program.back), "s"),
        *rows_of_returns(name, seen, returns, interval),
        at_least(
            f"{name}: frames after returns with a pose in the map, in the end",
            100.0 * float(main_part[after:].mean()),
            "%",
            95.0,
        ),
        Row(
            f"{name}: with a pose as they came",
            100.0 * sum(i >= after for i in seen.poses) / len(main_part[after:]),
            "%",
        ),
        Row(f"{name}: error of one stream, the same frames, median", alone, "cm"),
        at_most(f"{name}: error with the losses, over that", error / alone, "", 1.5),
    ]


def numbered(items: Sequence[Item]) -> list[Item]:
    return [replace(item, index=n) for n, item in enumerate(items)]


def measure(options: argparse.Namespace) -> list[Row]:
    cv2.setNumThreads(1)
    if options.quick:
        return [row for name, case in QUICK.items() for row in rows_of(name, case, QUICK_AWAY)]
    wanted = SCENES if options.scenes is None else {name: SCENES[name] for name in options.scenes}
    there = {name: case for name, case in wanted.items() if case.there}
    return [row for name, case in there.items() for row in rows_of(name, case, AWAY)] + missing(wanted)


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"separated by semicolons, of {'; '.join(SCENES)}; default: all that are here"
    parser.add_argument("--scenes", type=names(SCENES, ";"), help=told)


if __name__ == "__main__":
    main(measure, "A camera that is lost five times", arguments)
