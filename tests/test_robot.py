"""A live stream that is attacked, broken off, renumbered and set back goes on, and says what happened."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import zmq

from bench.faults.frame_mutations import frame as false_frame
from msgs import End, Frame
from msgs.codec import NEWEST, encode
from mvsgs_core.stream_times import StreamTimes
from nodes.robot import Robot
from nodes.runtime.addresses import TransportError
from nodes.runtime.explained import is_explained
from nodes.runtime.transport import create_keys
from nodes.runtime.transport.live import LivePublisher, LiveReader
from tests.support.live_programs import INTERVAL, Program, looked_at, received
from tests.support.patience import LONG, until
from tests.support.ports import tcp_address
from tests.support.shared_data import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture
def address() -> str:
    return tcp_address()


@pytest.fixture
def robot(address: str) -> Robot:
    return Robot(Robot.Config(path=address, timeout=20.0))


def picture(number: int, timestamp: float | None = None) -> Frame:
    image = np.full((24, 32, 3), number % 256, dtype=np.uint8)
    return Frame(number, number / 10 if timestamp is None else timestamp, image, np.array([25.0, 25, 15.5, 11.5]))


def data(number: int, sequence: int | None = None, timestamp: float | None = None) -> bytes:
    sequence = number if sequence is None else sequence
    return bytes(encode(picture(number, timestamp), sequence, delivery=NEWEST))


END = bytes(encode(End(), 2**40, delivery=NEWEST))


def numbers(frames: list[Frame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]


@pytest.mark.parametrize(
    "garbage",
    [
        false_frame(b"End", b""),
        false_frame(b"End", b"\x83", header_bytes=2**32 - 1),
        false_frame(b"End", b"\xdc\x10\x00" * 1000),
        END[:-1],
        END + b"\0",
        b"N",
        b"NMVS\x02\x05\0\0",
    ],
    ids=["empty", "false length", "unfinished", "cut off", "longer", "a byte", "a prefix"],
)
def test_what_is_no_end_does_not_end_a_stream(robot: Robot, garbage: bytes) -> None:
    def frames() -> Iterator[bytes]:
        for i in range(40):
            yield garbage if i % 4 == 2 else data(i)
        yield END

    assert numbers(received(robot, frames())) == [i for i in range(40) if i % 4 != 2]
    assert robot.stats.counts["refused"] == 10
    assert all(text.isprintable() for text in robot.stats.warnings)


def test_a_frame_of_300_megabytes_does_not_cut_the_stream_off(robot: Robot) -> None:
    sent = count()

    def until_taken() -> Iterator[bytes]:
        """Until some frames have come since."""
        before = looked_at(robot)
        while looked_at(robot) < before + 5:
            yield data(next(sent))

    def frames() -> Iterator[bytes]:
        yield from until_taken()
        for reconnected in (1, 2):
            yield b"N" + bytes(300 * 2**20)
            while robot._reader.reconnected < reconnected:
                yield data(next(sent))
            yield from until_taken()
        yield END

    taken = received(robot, frames(), in_step=False)
    assert numbers(taken)[-1] == next(sent) - 1
    assert robot.stats.counts["reconnected"] == 2
    assert any("was made anew" in text for text in robot.stats.warnings)


def test_dropped_is_what_can_have_been_sent(robot: Robot) -> None:
    jumps = {10: 2**62, 11: 5, 20: 2**40, 30: 2**63 - 1}

    def frames() -> Iterator[bytes]:
        for i in range(40):
            yield data(i, sequence=jumps.get(i, 100 + i))
        yield bytes(encode(End(), 150, delivery=NEWEST))

    assert numbers(received(robot, frames())) == list(range(40))
    assert robot.stats.counts["dropped"] == (112 - 6) + (150 - 140)  # after 5 and before the end
    assert robot.stats.counts["renumbered"] == 6  # there and back, but for 112 after 5
    assert any("sequence numbers jumped" in text for text in robot.stats.warnings)


def test_a_program_that_is_killed_and_starts_again_goes_on(address: str) -> None:
    robot = Robot(Robot.Config(path=address, timeout=10.0))
    first = Program(robot, (data(i) for i in range(100, 200)))
    taken: list[Frame] = []
    again: Program | None = None
    for message in robot.run():
        if isinstance(message, Frame):
            taken.append(message)
            if len(taken) == 10:
                first.close()
                again = Program(robot, iter([*map(data, range(20)), bytes(encode(End(), 20, delivery=NEWEST))]))
    assert again is not None
    again.close()
    assert numbers(taken)[:10] == list(range(100, 110))
    assert numbers(taken)[-20:] == list(range(20))
    times = [frame.timestamp for frame in taken]
    assert all(b > a for a, b in pairwise(times))
    assert times[-1] - times[0] < 10.0
    assert robot.stats.counts["times_repaired"] == 1
    assert robot.stats.counts["renumbered"] == 1
    assert "out_of_order" not in robot.stats.counts  # its clock is believed from its first frame on
    assert robot.stats.counts["lost"] == 1
    told = [text for text in robot.stats.warnings if "the robot" in text and "loss 1" in text]
    assert told[0] == "the robot was lost (its connection broke; loss 1): it is waited for up to 10 s"
    assert told[1].startswith("the robot is back after ")


def test_times_always_go_forward() -> None:
    now = [0.0]
    times = StreamTimes(lambda: now[0])

    def at(passed: float, timestamp: float) -> float | None:
        now[0] += passed
        return times.accept(timestamp)

    assert at(0, 1e9) == 1e9
    assert at(0.1, 1e9 + 0.1) == 1e9 + 0.1
    assert times.repaired == 0
    assert at(0.1, 1e9 + 0.1) == pytest.approx(1e9 + 0.2)  # the same again
    assert at(0.1, 1e9 + 0.2) == pytest.approx(1e9 + 0.3)
    assert times.repaired == 1
    assert at(0.1, 0.0) is None  # back: late, or the clock was set
    assert at(0.1, 0.1) is None
    assert at(0.1, 1e9 + 0.5) == pytest.approx(1e9 + 0.6)  # no, it was late
    assert [at(0.1, 0.1 * i) for i in range(4)] == [None] * 4
    assert at(0.1, 0.4) == pytest.approx(1e9 + 1.1)  # five in a row: it was set
    assert at(0.1, 0.5) == pytest.approx(1e9 + 1.2)
    assert times.repaired == 2
    assert [at(1.0, 9e10), at(1.0, 9e10 + 1.0)] == [None, pytest.approx(1e9 + 3.2)]  # ahead by far more than passed
    assert times.repaired == 3
    for absurd in (1e300, -1e300, 1.7e18, float("inf"), float("nan")):
        assert at(0.0, absurd) is None
    assert at(0.0, 9e10 + 1.0) == pytest.approx(1e9 + 3.2, abs=1e-3)  # at the same moment, and still later
    now[0] += 2.0
    assert times.accept(3.0, restarted=True) == pytest.approx(1e9 + 5.2, abs=1e-3)  # who began anew is believed
    played_fast = StreamTimes(lambda: now[0])
    assert [played_fast.accept(t) for t in (0.0, 0.5, 1000.0)] == [0.0, 0.5, 1000.0]
    assert played_fast.repaired == 0


def test_false_times_are_refused_and_said(robot: Robot) -> None:
    odd = {5: 1e300, 8: 0.2, 12: 1.2e18}

    def frames() -> Iterator[bytes]:
        for i in range(20):
            yield data(i, timestamp=odd.get(i))
        yield END

    taken = received(robot, frames())
    assert numbers(taken) == [i for i in range(20) if i not in odd]
    assert [frame.timestamp for frame in taken] == pytest.approx([i / 10 for i in numbers(taken)])
    assert (robot.stats.counts["unusable"], robot.stats.counts["out_of_order"]) == (3, 1)
    assert "times_repaired" not in robot.stats.counts
    assert any("no time in seconds" in text for text in robot.stats.warnings)
    assert any("those that came before were left out" in text for text in robot.stats.warnings)


def test_a_clock_that_was_set_back_costs_some_frames_and_not_the_stream(robot: Robot) -> None:
    tenths = count()  # one passes from frame to frame
    robot._frames._times._clock = lambda: next(tenths) / 10

    def frames() -> Iterator[bytes]:
        for i in range(40):
            yield data(i, timestamp=1000 + i / 10 if i < 20 else i / 10)
        yield END

    taken = received(robot, frames())
    assert numbers(taken) == [*range(20), *range(24, 40)]
    assert [frame.timestamp for frame in taken] == pytest.approx([1000 + i / 10 for i in numbers(taken)])
    assert robot.stats.counts["times_repaired"] == 1
    assert robot.stats.counts["out_of_order"] == 4
    assert any("stood still, went back or leapt" in text for text in robot.stats.warnings)


def test_doubled_frames_and_those_of_another_size_are_counted_and_refused(robot: Robot) -> None:
    other = Frame(3, 0.35, np.zeros((48, 64, 3), np.uint8), np.array([25.0, 25, 15.5, 11.5]))

    def frames() -> Iterator[bytes]:
        for i in range(20):
            yield data(i)
            if i == 5:
                yield from [data(i)] * 3
            if i == 9:
                yield bytes(encode(other, i, delivery=NEWEST))
        yield END

    taken = received(robot, frames())
    assert numbers(taken) == list(range(20))
    assert {frame.image.shape for frame in taken} == {(24, 32, 3)}
    assert robot.stats.counts["doubled"] == 3
    assert robot.stats.counts["other_size"] == 1
    assert robot.stats.counts["unusable"] == 4


@pytest.mark.parametrize(
    "change",
    [
        lambda f: replace(f, intrinsics=np.array([1e300, 1e300, 15.5, 11.5])),
        lambda f: replace(f, intrinsics=np.array([1e-300, 25.0, 15.5, 11.5])),
        lambda f: replace(f, intrinsics=np.array([25.0, 25.0, 1e9, 11.5])),
        lambda f: replace(f, intrinsics=np.array([25.0, np.nan, 15.5, 11.5])),
        lambda f: replace(f, image=np.zeros((1, 1, 3), np.uint8)),
        lambda f: replace(f, image=np.zeros((1, 70_000, 3), np.uint8)),
    ],
    ids=["telescope", "no focal length", "center", "nan", "a pixel", "a line"],
)
def test_a_frame_that_no_camera_takes_is_left_out_even_as_the_first(
    robot: Robot, change: Callable[[Frame], Frame]
) -> None:
    def frames() -> Iterator[bytes]:
        for i in range(20):
            yield bytes(encode(change(picture(i)) if i in (0, 10) else picture(i), i, delivery=NEWEST))
        yield END

    assert numbers(received(robot, frames())) == [i for i in range(20) if i not in (0, 10)]
    assert robot.stats.counts["unusable"] == 2


def test_only_garbage_is_no_stream_and_the_error_says_what_came(address: str) -> None:
    robot = Robot(Robot.Config(path=address, timeout=1.0))
    program = Program(robot, (data(i, timestamp=1e18) for i in range(1000)))
    began = time.monotonic()
    with pytest.raises(TimeoutError, match="no time in seconds"):
        list(robot.run())
    assert time.monotonic() - began < 10.0  # garbage for 20 s does not keep the stream open
    program.close()


@pytest.mark.parametrize("sent", [b"\xff\xd8\xff\xe0 as a JPEG begins", b""], ids=["a JPEG", "nothing"])
def test_a_program_that_sends_something_else_is_no_missing_program(address: str, sent: bytes) -> None:
    """Which a PUB socket does not even hand on to a reader of our messages."""
    robot = Robot(Robot.Config(path=address, timeout=1.5))
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        publisher.bind(address)
        stop = threading.Event()

        def publish() -> None:
            while sent and not stop.wait(INTERVAL):
                publisher.send(sent)

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            with pytest.raises(TimeoutError, match="answers there, but nothing that it sends is a message of this"):
                list(robot.run())
        finally:
            stop.set()
            thread.join()
    with pytest.raises(TimeoutError, match="is the program that publishes there running"):
        list(Robot(Robot.Config(path=address, timeout=0.5)).run())


# ---------------------------------------------------------------- the program in examples/


def example(*arguments: str, errors: Path | None = None) -> subprocess.Popen[str]:
    """Errors go to that file, or to a pipe."""
    command = [sys.executable, "-u", str(ROOT / "examples/robot.py"), *arguments]
    if errors is None:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with errors.open("w") as file:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file, text=True)


def wait_until_it_says(file: Path, text: str) -> None:
    until(lambda: text in file.read_text(), what=file.read_text)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    for i in range(8):
        writer.write(np.full((48, 64, 3), 8 * i, dtype=np.uint8))
    writer.release()
    return path


def test_guessed_intrinsics_are_sent_as_guessed_and_said(address: str, video: Path) -> None:
    for given, guessed in ((["--intrinsics", "50", "50", "31.5", "23.5"], False), ([], True)):
        with example("--video", str(video), "--address", address, *given) as program:
            robot = Robot(Robot.Config(path=address, timeout=LONG))
            frames = [message for message in robot.run() if isinstance(message, Frame)]
            errors = program.communicate(timeout=LONG)[1]
        assert frames
        assert {frame.intrinsics_guessed for frame in frames} == {guessed}
        assert ("the intrinsics are a guess" in errors) == guessed


def test_a_reader_with_other_keys_is_named_at_both_ends(address: str, video: Path, tmp_path: Path) -> None:
    create_keys(tmp_path / "a")
    create_keys(tmp_path / "b")
    other = "its keys are not those in"
    for ours, theirs, text in ((None, "a", other), ("b", "a", other), ("a", None, "it has keys")):
        given = [] if theirs is None else ["--keys", str(tmp_path / theirs)]
        said = tmp_path / "said"
        with example("--video", str(video), "--address", address, *given, errors=said) as program:
            try:
                config = Robot.Config(path=address, timeout=LONG, keys=None if ours is None else str(tmp_path / ours))
                with pytest.raises(ConnectionError, match="keys") as raised:
                    list(Robot(config).run())
                assert is_explained(raised.value), "a user is shown no traceback"
                wait_until_it_says(said, text)
            finally:
                program.terminate()
                program.communicate(timeout=LONG)  # it ends as by Ctrl-C, however this test was started
                assert program.returncode == 0
        assert "Traceback" not in said.read_text()


def test_the_launcher_refuses_a_robot_without_its_keys(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mvsgs keys"):
        Robot.check(Robot.Config(keys=str(tmp_path)))
    with pytest.raises(ValueError, match="is no address"):
        Robot.check(Robot.Config(path="localhost:5555"))
    Robot.check(Robot.Config())
    done = example("--video", "x.mp4", "--keys", str(tmp_path))
    assert "error: no keys at" in done.communicate(timeout=LONG)[1]
    assert done.returncode == 1


def test_a_stranger_who_tries_for_hours_does_not_stop_the_stream(address: str, tmp_path: Path) -> None:
    keys = create_keys(tmp_path / "keys")
    publisher, reader = LivePublisher(address, keys=keys), LiveReader(address, Frame, keys=keys)
    try:
        for _ in range(3000):  # without keys; nobody asks the publisher how many were refused
            with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as stranger:
                stranger.sendall(b"\xff" + bytes(8) + b"\x7f\x03\x01NULL" + bytes(48))
                with suppress(ConnectionError):
                    while stranger.recv(100):
                        pass
        until(lambda: publisher.refused == 3000, what=lambda: publisher.refused)
        until(lambda: publisher.ready(1))
        publisher.send(picture(0))
        until(lambda: reader.take() is not None)
    finally:
        publisher.close()
        reader.close()


def test_an_address_that_is_taken_is_named(address: str) -> None:
    first = LivePublisher(address)
    with pytest.raises(TransportError, match=f"cannot bind {address}: Address already in use"):
        LivePublisher(address)
    first.close()
