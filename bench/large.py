"""A large map: the tracker's time and memory a keyframe as a map grows to thousands, and its error after loops.

Two measurements, each in a process of its own. `driven`: the tracker along the streets of a synthetic town, which a
further process renders, so that the process's memory is the tracker's own. `enlarged`: two trackers on the same frames,
one of which is given copies of its own keyframes far away until its map has thousands: what a keyframe costs in a large
map over what it costs in a small one, in turns, frame by frame. So the growth is measured in minutes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection

import cv2
import numpy as np
import psutil

from bench.aligned import aligned_error
from bench.table import Row, at_least, at_most, main
from mvsgs_core.datasets import Item
from mvsgs_core.datasets.synthetic import Synthetic
from mvsgs_core.tracking.graph import Edge, Keyframe
from mvsgs_core.tracking.tracker import Tracker
from nodes.runtime.freed_memory import FreedMemory

SIZE = (120, 160)  # of the frames; the tracker enlarges them to 240x320, the area that it has by default
STREETS = 12  # either way: 17 kilometers
STRIDE = 2  # of the path's frames, a quarter of a meter each: at 20 frames a second 36 km/h
LARGE = 5000  # keyframes
GROWTH = 1.3  # of the time a keyframe: what counts as flat
MEMORY = 4000.0  # MB of a process
ERROR = 0.3  # % of the path
FAR = 1e3  # lengths of the map's unit between copies


@dataclass
class Costs:
    """What frames took that became keyframes, and the process's memory then."""

    seconds: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)  # MB

    def tenth(self, n: int) -> float:
        """Median of the seconds in the n-th tenth of the keyframes, from 0."""
        cuts = np.linspace(0, len(self.seconds), 11).astype(int)
        return float(np.median(self.seconds[cuts[n] : cuts[n + 1]]))


def town(frames: int, loop: bool = False) -> Synthetic:
    return Synthetic(scene="town", size=SIZE, frames=frames, loop=loop, threads=1)


def render(to: Connection, frames: int) -> None:
    """A process of its own: so many frames along the streets of a large town, without their depth."""
    for item in Synthetic(scene="town", size=SIZE, frames=STRIDE * frames, stride=STRIDE, streets=STREETS, threads=1):
        to.send(replace(item, depth=None))
    to.close()


def streamed(frames: int) -> Iterator[Item]:
    """What `render` gives. Raises EOFError where it ends too early."""
    spawning = multiprocessing.get_context("spawn")
    here, there = spawning.Pipe(duplex=False)
    renderer = spawning.Process(target=render, args=(there, frames), daemon=True)
    renderer.start()
    there.close()
    for _ in range(frames):
        yield here.recv()
    renderer.join()


def follow(tracker: Tracker, item: Item, costs: Costs) -> None:
    """One frame; noted where it became a keyframe."""
    start = time.process_time()
    update = tracker.add(item.index, item.timestamp, item.image, item.intrinsics)
    if update.keyframes:
        costs.seconds.append(time.process_time() - start)
        costs.memory.append(memory())


def memory() -> float:
    """MB that the process holds."""
    return float(psutil.Process().memory_info().rss / 1e6)


def driven(frames: int) -> list[Row]:
    """Along the streets, `frames` far; what is freed goes back to the system as it does in a node."""
    tracker, costs, truths = Tracker(clock=time.process_time), Costs(), []
    freed = FreedMemory()
    for item in streamed(frames):
        assert item.world_from_cam is not None
        truths.append(item.world_from_cam[:3, 3])
        follow(tracker, item, costs)
        freed.give_back()
    start, there = time.process_time(), memory()
    for _ in tracker.finish():
        pass
    finishing, peak = time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    path = np.array(truths)
    found = tracker.trajectory()
    main_part = found.main()
    length = float(np.linalg.norm(np.diff(path[main_part], axis=0), axis=1).sum())
    error = 100.0 * aligned_error(found.world_from_cam[main_part, :3, 3], path[main_part]) / length
    keyframes, counts = len(tracker.session.graph.keyframes), tracker.stats.counts
    each = (costs.memory[-1] - costs.memory[len(costs.memory) // 10]) / (0.9 * len(costs.memory))
    rows = [
        Row("driven: frames", frames),
        Row("driven: keyframes", keyframes),
        Row("driven: path", float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()), "m"),
        Row("driven: loops", int(counts.get("loops", 0))),
        Row("driven: loops that moved the map", int(counts.get("loops that moved the map", 0))),
        at_least("driven: frames in the largest part", 100.0 * float(main_part.mean()), "%", 95.0),
        at_most("driven: error of these", error, "% of the path", ERROR),
        Row("driven: time a keyframe, second tenth", 1e3 * costs.tenth(1), "ms"),
        at_most("driven: last tenth over the second", costs.tenth(9) / costs.tenth(1), "", GROWTH),
        Row("driven: at the end of the stream", 1e3 * finishing / keyframes, "ms a keyframe"),
        Row("driven: memory of the first keyframe's process", costs.memory[0], "MB"),
        Row("driven: memory that a keyframe adds", 1e3 * each, "kB"),
        Row("driven: memory as the stream ends", there, "MB"),
    ]
    if keyframes >= LARGE:
        return [*rows, at_most("driven: most memory, the end's adjustment included", peak, "MB", MEMORY)]
    rows.append(Row("driven: most memory, the end's adjustment included", peak, "MB"))
    large = peak + each * (LARGE - keyframes)
    return [*rows, at_most("driven: the same with 5,000 keyframes, extrapolated", large, "MB", MEMORY)]


def enlarge(tracker: Tracker, total: int) -> None:
    """Copies of the map's keyframes and edges until there are `total`, far from it and from one another.

    What they look like is like nothing else: the bits of their descriptors are in another order.
    """
    session = tracker.session
    graph, random = session.graph, np.random.default_rng(0)
    own, edges = sorted(graph.keyframes), list(graph.edges.items())
    for copy in range(1, -(-total // len(own))):
        number = {index: n - copy * len(own) for n, index in enumerate(own)}
        bits = random.permutation(256)
        for index in own[: max(0, total - len(graph.keyframes))]:
            old = graph.keyframes[index]
            points, descriptors = old.image.features()
            other = np.packbits(np.unpackbits(descriptors, axis=1)[:, bits], axis=1)
            image = replace(old.image.bare(), index=number[index], gray=old.image.gray.copy())
            image._features = points.copy(), other
            pose = old.cam_from_world.copy()
            pose[:3, 3] += pose[:3, :3] @ [FAR * copy, 0.0, 0.0]
            graph.add(Keyframe(image, pose, old.inverse_depth.copy(), old.information.copy(), old.segment))
            session.loops.add(number[index])
            session.publisher.publish(number[index])
        for (a, b), edge in edges:
            if number[a] in graph.keyframes and number[b] in graph.keyframes:
                graph.edges[number[a], number[b]] = Edge(
                    edge.target.copy(), edge.weight.copy(), edge.velocity.copy(), edge.fraction
                )
        session.photometer.update()
        for index in number.values():
            if index in graph.keyframes:
                graph.keyframes[index].image.release()
    session.publisher.corrections()  # what was never looked at is looked at once


def enlarged(frames: int, begin: int, total: int) -> list[Row]:
    """Two trackers on the same frames: the map of one is enlarged after `begin` of them."""
    trackers, costs = [Tracker(clock=time.process_time) for _ in range(2)], [Costs(), Costs()]
    before: list[dict[str, float]] = []
    added, there = 0.0, 0
    for item in town(frames):
        if item.index == begin:
            memory = psutil.Process().memory_info().rss
            there = len(trackers[1].session.graph.keyframes)
            enlarge(trackers[1], total)
            added = (psutil.Process().memory_info().rss - memory) / 1e3 / (total - there)
            costs = [Costs(), Costs()]
            before = [dict(tracker.stats.seconds) for tracker in trackers]
        for tracker, cost in zip(trackers, costs, strict=True):
            follow(tracker, item, cost)
    small, large = (float(np.sum(cost.seconds)) for cost in costs)
    poses = [np.stack([t.session.graph.world_from_cam(k) for k in _newest(t, begin)]) for t in trackers]
    rows = [
        Row("enlarged: keyframes in the small map", len(trackers[0].session.graph.keyframes)),
        Row("enlarged: keyframes in the large one", len(trackers[1].session.graph.keyframes)),
        alike(*poses),
        Row("enlarged: time a keyframe in the small map", 1e3 * small / len(costs[0].seconds), "ms"),
        at_most("enlarged: large over small", large / small, "", GROWTH),
        Row("enlarged: memory that a keyframe adds", added, "kB"),
    ]
    for stage in sorted(before[0]):
        a, b = (tracker.stats.seconds[stage] - old[stage] for tracker, old in zip(trackers, before, strict=True))
        if max(a, b) > 0.02 * small:
            n = len(costs[0].seconds)
            rows.append(Row(f"enlarged: {stage}, more than in the small map", 1e3 * (b - a) / n, "ms a keyframe"))
    return rows


def alike(small: np.ndarray, large: np.ndarray) -> Row:
    """Whether the poses (N, 4, 4) of both trackers are: what a large map has besides must not change them."""
    same = np.array_equal(small, large)
    return Row("enlarged: the same poses", str(same), "", "True", same)


def _newest(tracker: Tracker, begin: int) -> list[int]:
    return [index for index in sorted(tracker.session.graph.keyframes) if index >= begin]


def alone(measured: Callable[..., list[Row]], *given: int) -> list[Row]:
    """The rows of a measurement in a process of its own, whose most memory is then that of this measurement alone."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), cv2.setNumThreads, (1,)) as process:
        return process.submit(measured, *given).result()


def measure(options: argparse.Namespace) -> list[Row]:
    frames = options.frames or (500 if options.quick else 6000)
    total = options.keyframes or (1000 if options.quick else LARGE)
    rows = [] if options.only == "driven" else alone(enlarged, 400, 250, total)
    return rows if options.only == "enlarged" else [*rows, *alone(driven, frames)]


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, help="of the drive")
    parser.add_argument("--keyframes", type=int, help="of the enlarged map")
    parser.add_argument("--only", choices=("driven", "enlarged"))


if __name__ == "__main__":
    main(measure, "A large map", arguments)
