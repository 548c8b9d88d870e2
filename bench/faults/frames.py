"""Frames that nobody should send: to the decoder, and among good ones to a robot's graph that runs."""

from __future__ import annotations

import contextlib
import gc
import itertools
import json
import tempfile
import threading
import time
import tracemalloc
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import zmq

import msgs
from bench.faults.frame_mutations import good, mutated
from bench.runs import launch
from bench.table import Row, at_least, at_most
from launch.ports import free_ports
from msgs import End, Frame, Message
from msgs.codec import NEWEST, CodecError, decode, encode
from mvsgs_core.datasets import open_dataset
from nodes.player import Player

SIZE = 120, 160  # pixels of the robot's images
RATE = 10.0  # good frames a second
TRACED = 20  # memory is measured of every so many frames, and of all that take long
LONG = 0.5e-3  # s
GIANT = 300 * 2**20  # bytes: more than a message may have
RUN_SECONDS = 600.0


def measure(quick: bool) -> list[Row]:
    if quick:
        return _decoder(2_000) + _graph(500, 120)
    return _decoder(150_000) + _graph(20_000, 240)


# ---------------------------------------------------------------- the decoder


def _decoder(count: int) -> list[Row]:
    frames = mutated(np.random.default_rng(0))
    gc.collect()
    gc.freeze()  # to look through all that was imported takes 100 ms, which is none of a decode's
    answers: Counter[str] = Counter()
    slowest, max_memory = 0.0, 0
    for i in range(count):
        data = next(frames)
        answer, seconds = _decode(data)
        answers[answer] += 1
        slowest = max(slowest, seconds)
        if i % TRACED == 0 or seconds > LONG:
            max_memory = max(max_memory, _memory(data))
    others = count - answers["message"] - answers["CodecError"]
    return [
        Row("mutated frames to the decoder", count, "frames"),
        Row("  of them messages all the same", answers["message"], "frames"),
        at_most("  answers but a message or CodecError", others, "frames", 0),
        at_most("  slowest decode, processor time", 1e3 * slowest, "ms", 50),
        at_most("  largest memory of one decode", max_memory / 1e6, "MB", 64),
    ]


def _decode(data: bytes) -> tuple[str, float]:
    """What came of it, and processor seconds."""
    began = time.thread_time()
    try:
        decode(data)
        answer = "message"
    except CodecError:
        answer = CodecError.__name__
    except Exception as error:
        answer = type(error).__name__
    return answer, time.thread_time() - began


def _memory(data: bytes) -> int:
    tracemalloc.start()
    with contextlib.suppress(CodecError):
        decode(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


# ---------------------------------------------------------------- a live robot's graph


class _Robot:
    """A program that publishes the synthetic room at `RATE`, mutated frames among its own, and two giants.

    What decodes as an End is left out: that is the publisher's own right.
    """

    def __init__(self, count: int, good: int) -> None:
        self.address = f"tcp://127.0.0.1:{free_ports(1)[0]}"
        self.mutated = self.good = 0
        self._count, self._goal = count, good
        self._images: set[bytes] = set()  # of good frames
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def taken(self, recording: Path) -> int:
        """How many of the good frames the graph has worked on."""
        player = Player(Player.Config(path=str(recording)))
        return len(self._images & {m.image.tobytes() for m in player.run() if isinstance(m, Frame)})

    def _work(self) -> None:
        items = list(open_dataset("synthetic", size=SIZE, frames=self._goal))
        room = [Frame(item.index, item.index / RATE, item.image, item.intrinsics) for item in items]
        bad = (data for data in mutated(np.random.default_rng(1), _originals(room)) if not _is_end(data))
        with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
            publisher.linger = 1000
            publisher.bind(self.address)
            while not publisher.poll(100):  # until a reader comes
                if self._stop.is_set():
                    return
            for number, frame in enumerate(room):
                began = time.monotonic()
                publisher.send(_sent(frame, number))
                self.good += 1
                self._images.add(frame.image.tobytes())
                if number in (self._goal // 3, 2 * self._goal // 3):
                    publisher.send(b"N" + bytes(GIANT))
                quota = (self._count - self.mutated) // (self._goal - number)
                for data in itertools.islice(bad, quota):
                    publisher.send(b"N" + data[1:])  # else no reader sees it
                    self.mutated += 1
                if self._stop.wait(max(0.0, began + 1 / RATE - time.monotonic())):
                    return
            while not self._stop.wait(0.1):  # a giant may have cut the last connection: until one hears it
                publisher.send(_sent(End(), self._goal))


def _originals(room: list[Frame]) -> list[Message]:
    """Half of what is mutated is as a frame of the stream, but for its colors: it is told apart from one afterwards."""
    rng = np.random.default_rng(2)
    others = [good(t, rng) for t in msgs.TYPES.values() for _ in range(4)]
    negatives = (replace(frame, image=255 - frame.image) for frame in itertools.cycle(room))
    return [*others, *itertools.islice(negatives, len(others))]


def _sent(message: Message, sequence: int) -> bytes:
    return bytes(encode(message, sequence, delivery=NEWEST))


def _is_end(data: bytes) -> bool:
    with contextlib.suppress(CodecError):
        return isinstance(decode(b"N" + data[1:]).message, End)
    return False


def _graph(count: int, good_frames: int) -> list[Row]:
    robot = _Robot(count, good_frames)
    with tempfile.TemporaryDirectory() as folder:
        try:
            run = launch(
                f"output={folder}/out", "dataset=robot", f"dataset.path={robot.address}", "dataset.timeout=60",
                "device=cpu", "mapper.iterations=5", "mapper.refinement=20", "evaluator.lpips=off", "screen=plain",
                "recorder=mcap", check=False, timeout=RUN_SECONDS,
            )  # fmt: skip
        finally:
            robot.close()
        lost = run.returncode != 0 or not (Path(folder) / "out/map.ply").exists()
        if lost:
            print(run.stdout[-2000:], run.stderr[-4000:], sep="\n")
            counts, taken = {}, 0
        else:
            taken = robot.taken(Path(folder) / "out/recording.mcap")
            counts = json.loads((Path(folder) / "out/report.json").read_text())["counts"]["dataset"]
    return [
        Row("mutated frames to a live robot's graph", robot.mutated, "frames"),
        Row("  of them refused", counts.get("refused", 0) + counts.get("unusable", 0), "frames"),
        at_most("  runs lost", int(lost), "runs", 0),
        at_least("  good frames taken", 100 * taken / robot.good, "%", 60),
        at_least("  connections made anew after a frame of 300 MiB", counts.get("reconnected", 0), "times", 1),
    ]
