"""The source nodes: recorded, live and remote."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zmq

from msgs import Depth, Frame, GroundTruth
from msgs.codec import decode
from nodes.reader import Reader
from nodes.robot import Robot
from nodes.runtime.transport import Publisher
from tests.support.dataset_folders import truncate, write_photos, write_tum
from tests.support.live_programs import wait_until_looked_at
from tests.support.patience import LONG, until
from tests.support.ports import tcp_address
from tests.support.shared_data import ROOT

# ---------------------------------------------------------------- recorded


def test_reader_sends_each_frame_and_then_its_truth(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3")
    truncate(folder / "rgb/1.png")
    reader = Reader(Reader.Config(name="tum", path=str(folder), size=[24, 32]))
    messages = list(reader.run())
    assert [type(m) for m in messages] == [Frame, GroundTruth] * 4
    for frame, truth in zip(messages[::2], messages[1::2]):
        assert isinstance(truth, GroundTruth)
        assert frame.index == truth.index
        assert frame.timestamp == truth.timestamp
        assert frame.image.shape == (24, 32, 3)
        np.testing.assert_array_equal(frame.image, truth.image)
        assert truth.world_from_cam is not None
    assert reader.stats.counts == {"frames": 4}
    assert reader.stats.values["frames_expected"] == 5
    assert reader.stats.values["lens"]["size"] == [480, 640]  # of the published calibration
    assert any("could not be read: 1 (first: 1.png" in w for w in reader.stats.warnings)


def test_an_interrupted_reader_still_tells_its_warnings(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3")
    (folder / "groundtruth.txt").unlink()
    truncate(folder / "rgb/0.png")
    reader = Reader(Reader.Config(name="tum", path=str(folder)))
    stream = reader.run()
    next(stream)
    assert reader.stats.warnings == ["groundtruth.txt is missing: the trajectory is not scored"]
    stream.close()  # type: ignore[attr-defined]
    assert any("could not be read: 1 (first: 0.png" in w for w in reader.stats.warnings)


def test_reader_passes_options_on(tmp_path: Path) -> None:
    config = Reader.Config(
        name="images", path=str(write_photos(tmp_path)), start=2, stop=8, stride=3, intrinsics=[50, 50, 31.5, 23.5],
        options={"rate": 2.0},
    )  # fmt: skip
    messages = list(Reader(config).run())
    assert [(m.index, m.timestamp, m.image[0, 0, 0]) for m in messages[::2]] == [(0, 1.0, 22), (1, 2.5, 25)]
    assert messages[1].world_from_cam is None
    assert messages[1].depth is None


@pytest.mark.parametrize("name", ["images", "video"])
def test_frames_say_the_intrinsics_of_the_original_images(name: str, tmp_path: Path) -> None:
    """In whose pixels `dataset.intrinsics` is."""
    path, given = tmp_path / "walk.avi", [50.0, 52.0, 31.0, 24.0]
    if name == "images":
        path = write_photos(tmp_path / "photos")
    else:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
        for number in range(3):
            writer.write(np.full((48, 64, 3), 80 * number, np.uint8))
        writer.release()
    config = Reader.Config(name=name, path=str(path), size=[24, 32], intrinsics=given, distortion=[-0.1, 0.0, 0.0, 0.0])
    for message in Reader(config).run():
        if isinstance(message, Frame):
            assert message.image.shape == (24, 32, 3)
            assert message.intrinsics[0] < 30.0
            assert message.original_intrinsics is not None
            assert message.original_intrinsics.tolist() == given


def test_reader_can_play_at_the_recorded_rate(tmp_path: Path) -> None:
    reader = Reader(Reader.Config(name="tum", path=str(write_tum(tmp_path / "fr3", 4)), realtime=True))
    began = time.monotonic()
    arrivals = [time.monotonic() - began for message in reader.run() if isinstance(message, Frame)]
    assert all(arrival >= 0.1 * i for i, arrival in enumerate(arrivals))  # the clock starts after `began`


def test_a_played_frame_says_when_it_was_due(tmp_path: Path) -> None:
    config = Reader.Config(name="tum", path=str(write_tum(tmp_path / "fr3", 4)), realtime=True)
    due = []
    for message in Reader(config).run():
        if isinstance(message, Frame):
            assert 0.0 <= time.time() - message.captured < 5.0
            due.append(message.captured)
            time.sleep(0.15)  # whoever takes the frames is slow: what is due does not wait for that
    assert np.diff(due) == pytest.approx([0.1] * 3, abs=0.01)
    assert all(m.captured == 0.0 for m in Reader(replace(config, realtime=False)).run())


# ---------------------------------------------------------------- remote


@pytest.fixture
def address() -> str:
    return tcp_address()


def frame(number: int, size: tuple[int, int] = (48, 64), focal: float = 50.0) -> Frame:
    image = np.full((*size, 3), number, dtype=np.uint8)
    return Frame(number, number / 10, image, np.array([focal, focal, 31.5, 23.5]))


def publish(robot: Robot, messages: list[Any]) -> threading.Thread:
    """Each when the robot's node has looked at the one before."""
    publisher = Publisher(robot.config.path)

    def work() -> None:
        until(lambda: publisher.ready(1))
        for number, message in enumerate(messages, start=1):
            publisher.send(message)
            wait_until_looked_at(robot, number)
        publisher.close()

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_robot_frames_arrive_and_are_numbered_anew(address: str) -> None:
    robot = Robot(Robot.Config(path=address, size=[24, 32], start=1, stride=2))
    sender = publish(robot, [frame(i) for i in range(100, 120)])
    messages = list(robot.run())
    sender.join()
    frames = messages[::2]
    assert [m.index for m in frames] == list(range(len(frames)))
    numbers = [int(m.image[0, 0, 0]) for m in frames]
    assert numbers == list(range(101, 120, 2))
    for message, number in zip(frames, numbers):
        assert message.timestamp == pytest.approx(number / 10)
        np.testing.assert_allclose(message.intrinsics, [25, 25, 15.5, 11.5])
    assert all(isinstance(m, GroundTruth) and m.world_from_cam is None for m in messages[1::2])


def test_a_slow_robot_reader_skips_and_counts(address: str) -> None:
    publisher, robot, due = Publisher(address), Robot(Robot.Config(path=address)), threading.Semaphore(1)

    def there(number: int) -> bool:
        """Whether the reader has it, taken or still waiting."""
        waiting = [decode(each.buffer).sequence for each in robot._reader._frames.copy()]
        return waiting == [number] or robot._reader.expected > number

    def work() -> None:
        until(lambda: publisher.ready(1) and hasattr(robot, "_reader"))
        for number in range(61):
            due.acquire()
            publisher.send(frame(number))
            until(partial(there, number))
        publisher.close()

    sender = threading.Thread(target=work)
    sender.start()
    numbers = []
    for message in robot.run():
        if isinstance(message, Frame):
            numbers.append(int(message.image[0, 0, 0]))
            due.release(10)
            until(partial(there, min(10 * len(numbers), 60)))
    sender.join()
    assert numbers == [0, 10, 20, 30, 40, 50, 60]  # the newest is never dropped
    assert robot.stats.counts["dropped"] == 9 * 6


@pytest.mark.slow
def test_a_robot_that_falls_silent_or_never_speaks(address: str) -> None:
    with pytest.raises(TimeoutError, match=r"examples/robot\.py"):
        list(Robot(Robot.Config(path=address, timeout=0.3)).run())
    publisher = Publisher(address)
    try:
        robot = Robot(Robot.Config(path=address, timeout=LONG))
        stream = robot.run()

        def send() -> None:
            until(lambda: publisher.ready(1))
            publisher.send(frame(3))

        sender = threading.Thread(target=send)
        sender.start()
        assert isinstance(next(stream), Frame)
        robot.config.timeout = 0.3  # from here on: until they have met, the machine may be busy
        assert [type(message) for message in stream] == [GroundTruth]
        sender.join()
        assert any("the stream ends here" in w for w in robot.stats.warnings)
    finally:
        publisher.close()


def test_what_a_robot_should_not_send_is_left_out(address: str) -> None:
    wrong_type = Depth(
        1, 0.1, np.zeros((4, 4, 3), np.uint8), np.ones(4), np.eye(4), 1.0,
        np.ones((4, 4), np.float32), np.ones((4, 4), np.float32), 0,
    )  # fmt: skip
    odd = [frame(0), wrong_type, frame(2, (32, 32)), frame(3, focal=-1.0), frame(4, focal=float("nan")), frame(5)]
    robot = Robot(Robot.Config(path=address))
    sender = publish(robot, odd)
    numbers = [int(m.image[0, 0, 0]) for m in robot.run() if isinstance(m, Frame)]
    sender.join()
    assert numbers == [0, 5]
    assert robot.stats.counts["refused"] == 1
    text = "\n".join(robot.stats.warnings)
    assert "what is no Frame" in text
    assert "another size" in text
    assert "valid intrinsics" in text


def test_a_foreign_program_that_follows_the_documented_format(address: str) -> None:
    """The plain Python of msgs/WIRE.md, on a plain PUB socket that knows nothing of this project."""
    code = (ROOT / "msgs/WIRE.md").read_text().split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {}
    exec(code, names)
    stop = threading.Event()

    def work() -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as socket:
            socket.linger = 0
            socket.bind(address)
            for number in itertools.count():
                if stop.wait(0.02):
                    return
                rgb = bytes([number % 256, 2, 3]) * (48 * 64)
                socket.send(names["frame"](number, number, number / 10, 48, 64, rgb, (50.0, 51.0, 31.5, 23.5)))

    sender = threading.Thread(target=work)
    sender.start()
    try:
        robot = Robot(Robot.Config(path=address, stop=5, timeout=10.0))
        frames = [message for message in robot.run() if isinstance(message, Frame)]
    finally:
        stop.set()
        sender.join()
    assert len(frames) == 5
    assert robot.stats.warnings == []
    for message in frames:
        assert message.image.shape == (48, 64, 3)
        assert message.image[7, 9].tolist() == [round(10 * message.timestamp) % 256, 2, 3]
        np.testing.assert_array_equal(message.intrinsics, [50, 51, 31.5, 23.5])


@pytest.mark.slow
def test_the_example_publishes_a_data_set(address: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", 6)
    command = [sys.executable, str(ROOT / "examples/robot.py"), "--dataset", "tum", str(folder), "--address", address]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as example:
        robot = Robot(Robot.Config(path=address, timeout=LONG))
        numbers = [int(m.image[0, 0, 0]) for m in robot.run() if isinstance(m, Frame)]
        output, errors = example.communicate(timeout=LONG)
    assert example.returncode == 0, errors
    assert numbers[-1] == 25
    assert numbers == sorted(set(numbers))
    assert "6 frames sent" in output
    assert "warning: frames without a depth map" in errors
