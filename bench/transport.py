"""Messages between two processes, beside plain pyzmq with multipart zero-copy: latency and throughput.

Ours is what nodes use: one checked frame, publish/subscribe without loss, arrival and departure watched. Plain is the
least that pyzmq needs for the same arrays: XPUB with NODROP, a msgpack header and one part an array, no copy on either
side and no check. Both run at the same time in the same two processes, message by message or burst by burst in turns,
so that whatever else the machine does meets both. Latency runs from before packing to after unpacking, at a rate that
leaves no queue. All is measured in rounds: a figure is the median of the rounds', with their spread.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import msgpack
import numpy as np
import zmq

from bench.table import Row, main, timed
from launch.ports import free_ports
from msgs import End, Frame, GroundTruth
from nodes.runtime.transport import Publisher, ReliableReader, shut_down, wait

T = TypeVar("T")
Sample = Frame | GroundTruth
BUFFER = 8  # messages, of both
FRESH = 32  # images sent in turns: a source gives each once, so none waits in a cache
GOAL = 1.5  # times plain pyzmq
WARM_UP = 10  # first messages that do not count: they wake connections and fill caches
BURSTS = 9  # of the throughput in a round


def samples() -> dict[str, Callable[[int, float], Sample]]:
    """Message of a kind with this index and time."""
    rng = np.random.default_rng(0)
    vga = rng.integers(0, 255, (FRESH, 480, 640, 3), np.uint8)
    depth = rng.random((FRESH, 480, 640), np.float32)
    large = rng.integers(0, 255, (FRESH, 1024, 1366, 3), np.uint8)
    camera = np.array([500.0, 500.0, 320.0, 240.0])
    return {
        "VGA RGB (0.9 MB)": lambda i, t: Frame(i, t, vga[i % FRESH], camera),
        "VGA RGB + depth (2.2 MB)": lambda i, t: GroundTruth(i, t, vga[i % FRESH], camera, None, depth[i % FRESH]),
        "large RGB (4.2 MB)": lambda i, t: Frame(i, t, large[i % FRESH], camera),
    }


class OursOut:
    def __init__(self, address: str) -> None:
        self._publisher = Publisher(address, buffer=BUFFER)
        while not self._publisher.ready(1):
            self._publisher.socket.poll(100)
        self._publisher.start()

    def send(self, message: Sample) -> None:
        self._publisher.send(message)

    def close(self) -> None:
        self._publisher.end(End())
        while not self._publisher.gone():
            self._publisher.socket.poll(100)
        self._publisher.close()


class OursIn:
    def __init__(self, address: str, kind: type) -> None:
        self._reader = ReliableReader(address, kind, buffer=BUFFER)

    def receive(self) -> float:
        """Waits for a message; its time."""
        while (message := self._reader.take()) is None:
            wait([self._reader.pollable, self._reader.monitor], 1.0)
            self._reader.watch()  # as a node does: an event of the connection that nobody takes wakes it for ever
        return message.timestamp if isinstance(message, Sample) else 0.0

    def close(self) -> None:
        while not self._reader.ended:
            self.receive()
        self._reader.close()


class PlainOut:
    def __init__(self, address: str) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, BUFFER)
        self._socket.setsockopt(zmq.XPUB_NODROP, 1)
        self._socket.bind(address)
        self._socket.recv()

    def send(self, message: Sample) -> None:
        arrays = {name: value for name, value in vars(message).items() if isinstance(value, np.ndarray)}
        header = {name: value for name, value in vars(message).items() if name not in arrays}
        header["arrays"] = [(name, array.dtype.str, array.shape) for name, array in arrays.items()]
        parts: list[Any] = [msgpack.packb(header), *arrays.values()]
        self._socket.send_multipart(parts, copy=False)

    def close(self) -> None:
        self._socket.recv()  # the reader's goodbye
        self._socket.close(linger=0)


class PlainIn:
    def __init__(self, address: str, kind: type) -> None:
        self._kind = kind
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, BUFFER)
        self._socket.subscribe(b"")
        self._socket.connect(address)

    def receive(self) -> float:
        header, *parts = self._socket.recv_multipart(copy=False)
        values: dict[str, Any] = msgpack.unpackb(header.buffer)
        for (name, dtype, shape), part in zip(values.pop("arrays"), parts, strict=True):
            values[name] = np.frombuffer(part.buffer, dtype).reshape(shape)
        return float(self._kind(**values).timestamp)

    def close(self) -> None:
        self._socket.unsubscribe(b"")
        self._socket.close(linger=500)


def in_turn(ways: Sequence[T], index: int) -> Iterable[T]:
    """Ours first, then plain first: neither always follows the other."""
    return ways if index % 2 == 0 else reversed(ways)


@dataclass(frozen=True)
class Amount:
    rounds: int
    messages: int  # of each way in a round, for the latency
    burst: int  # messages, for the throughput


@dataclass(frozen=True)
class Round:
    """Of ours and of plain, measured in turns."""

    latencies: list[np.ndarray]  # s
    rates: list[list[float]]  # messages a second of each burst

    def latency(self, quantile: float) -> tuple[float, float]:
        ours, plain = (float(np.quantile(seconds, quantile)) for seconds in self.latencies)
        return ours, plain

    def rate(self) -> tuple[float, float]:
        return statistics.median(self.rates[0]), statistics.median(self.rates[1])

    def times_faster(self) -> float:
        """Plain, by pairs of bursts that followed each other."""
        return statistics.median(plain / ours for ours, plain in zip(*self.rates, strict=True))


def _read(addresses: tuple[str, str], kind: type, amount: Amount, results: Connection) -> None:
    """The reading process: in each round seconds of each message by way, then seconds of each burst by way."""
    ways: tuple[OursIn | PlainIn, ...] = (OursIn(addresses[0], kind), PlainIn(addresses[1], kind))
    for number in range(amount.rounds):
        latencies: tuple[list[float], list[float]] = ([], [])
        for index in range(amount.messages + (WARM_UP if number == 0 else 0)):
            for way, seconds in in_turn(list(zip(ways, latencies, strict=True)), index):
                sent = way.receive()
                seconds.append(time.monotonic() - sent)
        results.send(latencies)
        for burst in range(BURSTS):
            for way in in_turn(ways, burst):
                results.recv()
                results.send("ready")
                way.receive()
                start = time.monotonic()
                for _ in range(amount.burst - 1):
                    way.receive()
                results.send(time.monotonic() - start)
    for way in ways:
        way.close()
    shut_down()


def measure_pair(addresses: tuple[str, str], sample: Callable[[int, float], Sample], amount: Amount) -> list[Round]:
    """The same messages by ours and by plain."""
    context = multiprocessing.get_context("spawn")
    ours_end, their_end = context.Pipe()
    process = context.Process(target=_read, args=(addresses, type(sample(0, 0.0)), amount, their_end))
    process.start()
    ways: tuple[OursOut | PlainOut, ...] = (OursOut(addresses[0]), PlainOut(addresses[1]))
    gap = 0.004 + sample(0, 0.0).image.nbytes * 2e-9  # s between messages: several times what one takes
    rounds = []
    for number in range(amount.rounds):
        unseen = WARM_UP if number == 0 else 0
        for index in range(amount.messages + unseen):
            for way in in_turn(ways, index):
                time.sleep(gap)
                way.send(sample(index, time.monotonic()))
        latencies = [np.array(seconds[unseen:]) for seconds in ours_end.recv()]
        rates: list[list[float]] = [[], []]
        for burst in range(BURSTS):
            for way, found in in_turn(list(zip(ways, rates, strict=True)), burst):
                ours_end.send("go")
                ours_end.recv()
                for index in range(amount.burst):
                    way.send(sample(index, time.monotonic()))
                found.append((amount.burst - 1) / ours_end.recv())
        rounds.append(Round(latencies, rates))
    for way in ways:
        way.close()
    process.join()
    return rounds


def measure(options: argparse.Namespace) -> list[Row]:
    rows: list[Row] = []
    amount = Amount(3, 50, 30) if options.quick else Amount(7, 200, 100)
    for transport in ("ipc", "tcp"):
        for name, sample in samples().items():
            with tempfile.TemporaryDirectory(prefix="mvsgs-") as folder:
                rounds = measure_pair(_addresses(transport, Path(folder)), sample, amount)
            megabytes = sum(v.nbytes for v in vars(sample(0, 0.0)).values() if isinstance(v, np.ndarray)) / 1e6
            title = f"{transport}, {name}"
            for label, quantile in (("median", 0.5), ("99th percentile", 0.99)):
                pairs = [each.latency(quantile) for each in rounds]
                rows += [
                    timed(f"{title}: latency, {label}", [1e3 * ours for ours, _ in pairs], "ms"),
                    timed(f"{title}: latency, {label}, plain pyzmq", [1e3 * plain for _, plain in pairs], "ms"),
                    timed(f"{title}: latency, {label}, ratio", [o / p for o, p in pairs], "x", maximum=GOAL),
                ]
            rates = [each.rate() for each in rounds]
            rows += [
                timed(f"{title}: throughput", [megabytes * ours for ours, _ in rates], "MB/s"),
                timed(f"{title}: throughput, plain pyzmq", [megabytes * plain for _, plain in rates], "MB/s"),
                timed(f"{title}: throughput, plain / ours", [e.times_faster() for e in rounds], "x", maximum=GOAL),
            ]
    shut_down()
    return rows


def _addresses(transport: str, folder: Path) -> tuple[str, str]:
    if transport == "ipc":
        return f"ipc://{folder}/ours", f"ipc://{folder}/plain"
    ours, plain = free_ports(2)
    return f"tcp://127.0.0.1:{ours}", f"tcp://127.0.0.1:{plain}"


if __name__ == "__main__":
    main(measure, "Transport: ours against plain pyzmq multipart zero-copy")
