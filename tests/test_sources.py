"""The source nodes: recorded, live and remote."""

from __future__ import annotations

import http.server
import itertools
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zmq

import nodes.camera
from msgs import Depth, Frame, GroundTruth
from nodes.camera import Camera, CameraError
from nodes.reader import Reader
from nodes.robot import Robot
from nodes.runtime.transport import Publisher
from tests.support.dataset_folders import truncate, write_photos, write_tum
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
    assert reader.stats.values == {"frames_expected": 5}
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


def test_reader_can_play_at_the_recorded_rate(tmp_path: Path) -> None:
    reader = Reader(Reader.Config(name="tum", path=str(write_tum(tmp_path / "fr3", 4)), realtime=True))
    began = time.monotonic()
    arrivals = [time.monotonic() - began for message in reader.run() if isinstance(message, Frame)]
    assert all(arrival >= 0.1 * i for i, arrival in enumerate(arrivals))  # the clock starts after `began`


# ---------------------------------------------------------------- live


class FakeCapture:
    """Stands for cv2.VideoCapture: a picture every `interval` seconds, gray with its number; `script` may fail."""

    interval = 0.01
    lost_after: int | None = None  # pictures, then no more until opened again
    dead_after: int | None = None  # pictures over all captures, then never again
    opened = 0
    pictures = 0

    def __init__(self, *arguments: object) -> None:
        type(self).opened += 1
        self._own = 0

    def isOpened(self) -> bool:
        return self.dead_after is None or self.pictures < self.dead_after

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(self.interval)
        if not self.isOpened() or (self.lost_after is not None and self._own >= self.lost_after):
            return False, None
        self._own += 1
        type(self).pictures += 1
        return True, np.full((48, 64, 3), (0, 0, self.pictures % 256), dtype=np.uint8)

    def set(self, *_: object) -> bool:
        return True

    def release(self) -> None:
        pass


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[FakeCapture]]:
    kind = type("Capture", (FakeCapture,), {})
    monkeypatch.setattr(nodes.camera.cv2, "VideoCapture", kind)
    monkeypatch.setattr(nodes.camera, "RETRY", 0.01)
    yield kind
    assert not [t for t in threading.enumerate() if t.name == "camera"], "the capture thread outlived its node"


def test_camera_delivers_frames_with_guessed_intrinsics(capture: type[FakeCapture]) -> None:
    camera = Camera(Camera.Config(start=2, stop=8, stride=2, size=[24, 32]))
    messages = list(camera.run())
    assert [type(m) for m in messages] == [Frame, GroundTruth] * 3
    assert [m.index for m in messages] == [0, 0, 1, 1, 2, 2]
    assert messages[0].image.shape == (24, 32, 3)
    assert messages[0].image[0, 0, 1] == 0  # RGB
    assert messages[0].image[0, 0, 0] > 0
    assert messages[0].intrinsics[2] == 15.5
    assert messages[0].intrinsics_guessed
    assert messages[1].world_from_cam is None
    assert any("guess" in w for w in camera.stats.warnings)


@pytest.mark.slow
def test_a_slow_reader_gets_the_newest_picture_and_the_rest_is_counted(capture: type[FakeCapture]) -> None:
    camera = Camera(Camera.Config(stop=5, intrinsics=[50, 50, 31.5, 23.5]))
    lag = []
    seen = 0
    for message in camera.run():
        if isinstance(message, Frame):
            seen = int(message.image[0, 0, 0])
            lag.append(capture.pictures - seen)
            time.sleep(0.15)
    assert camera.stats.warnings == []
    assert camera.stats.counts["frames"] == 5
    assert max(lag) <= 2  # never an old picture, although some 15 were taken meanwhile
    assert camera.stats.counts["dropped"] >= seen - 5 > 10


def test_a_camera_that_comes_back(capture: type[FakeCapture]) -> None:
    capture.lost_after = 4
    camera = Camera(Camera.Config(stop=10))
    assert len(list(camera.run())) == 20
    assert any("was lost and found again" in w for w in camera.stats.warnings)


def test_a_loss_is_told_when_it_happens_and_so_is_the_return(capture: type[FakeCapture]) -> None:
    capture.lost_after = 4
    camera = Camera(Camera.Config(stop=10))
    told: list[int] = []  # warnings at each frame
    for message in camera.run():
        if isinstance(message, Frame):
            told.append(sum("lost" in w for w in camera.stats.warnings))
    assert told[0] == 0
    assert told[-1] == 2  # lost, found: both while frames still came
    assert camera.stats.warnings[-2].endswith("was lost: it is opened again until it is found")


@pytest.mark.slow
def test_a_camera_that_hangs_is_told_before_it_is_given_up(capture: type[FakeCapture]) -> None:
    capture.dead_after = 3
    camera = Camera(Camera.Config(timeout=1.0))
    when: dict[str, float] = {}
    camera.stats.warn = lambda text: when.setdefault(text, time.monotonic()) and None  # type: ignore[method-assign]
    list(camera.run())
    given_up = when["camera 0 was lost: no picture for 1 s"]
    assert given_up - when["camera 0 gives no picture: it is waited for up to 1 s"] > 0.2
    assert given_up - when["camera 0 was lost: it is opened again until it is found"] > 0.5


def test_a_camera_that_dies_ends_the_stream_and_not_the_run(capture: type[FakeCapture]) -> None:
    capture.dead_after = 3
    camera = Camera(Camera.Config(timeout=0.3))
    messages = list(camera.run())
    assert 2 <= len(messages) <= 6
    assert "camera 0 was lost: no picture for 0.3 s" in camera.stats.warnings


def test_a_camera_that_is_not_there(capture: type[FakeCapture], tmp_path: Path) -> None:
    capture.dead_after = 0
    with pytest.raises(CameraError, match="camera 7 cannot be opened: is it connected"):
        list(Camera(Camera.Config(path="7")).run())
    with pytest.raises(CameraError, match="rtsp://nowhere/x cannot be opened: is the address right"):
        list(Camera(Camera.Config(path="rtsp://nowhere/x")).run())
    capture.dead_after, capture.lost_after = None, 0
    with pytest.raises(CameraError, match=r"gave no picture for 0\.2 s"):
        list(Camera(Camera.Config(timeout=0.2)).run())
    (tmp_path / "walk.mp4").touch()
    with pytest.raises(CameraError, match="dataset=video"):
        list(Camera(Camera.Config(path=str(tmp_path / "walk.mp4"))).run())


class Stream(http.server.BaseHTTPRequestHandler):
    """Motion JPEG, as network cameras send it; silent after 20 pictures."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        try:
            for number in range(20):
                data = cv2.imencode(".jpg", np.full((48, 64, 3), 10 * number, dtype=np.uint8))[1].tobytes()
                head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")
                time.sleep(0.02)
            time.sleep(3.0)
        except ConnectionError:
            pass  # the reader left

    def log_message(self, *_: object) -> None:
        pass


@pytest.mark.slow
def test_a_network_camera_that_falls_silent() -> None:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Stream)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        camera = Camera(Camera.Config(path=f"http://127.0.0.1:{server.server_port}/video.mjpg", timeout=1.5))
        began = time.monotonic()
        values = [int(message.image[0, 0, 0]) for message in camera.run() if isinstance(message, Frame)]
        assert time.monotonic() - began < 8
    finally:
        server.shutdown()
        server.server_close()
    assert len(values) > 10
    assert values == sorted(values)
    assert any("was lost: no picture for 1.5 s" in w for w in camera.stats.warnings)


# ---------------------------------------------------------------- remote


@pytest.fixture
def address() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def frame(number: int, size: tuple[int, int] = (48, 64), focal: float = 50.0) -> Frame:
    image = np.full((*size, 3), number, dtype=np.uint8)
    return Frame(number, number / 10, image, np.array([focal, focal, 31.5, 23.5]))


def publish(publisher: Publisher, messages: list[Frame], interval: float = 0.02) -> threading.Thread:
    def work() -> None:
        while not publisher.ready(1):
            time.sleep(0.01)
        for message in messages:
            publisher.send(message)
            time.sleep(interval)
        publisher.close()

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_robot_frames_arrive_and_are_numbered_anew(address: str) -> None:
    sender = publish(Publisher(address), [frame(i) for i in range(100, 120)])
    robot = Robot(Robot.Config(path=address, size=[24, 32], start=1, stride=2))
    messages = list(robot.run())
    sender.join()
    frames = messages[::2]
    assert [m.index for m in frames] == list(range(len(frames)))
    numbers = [int(m.image[0, 0, 0]) for m in frames]
    assert numbers == sorted(set(numbers))
    assert len(frames) >= 5
    for message, number in zip(frames, numbers):
        assert message.timestamp == pytest.approx(number / 10)
        np.testing.assert_allclose(message.intrinsics, [25, 25, 15.5, 11.5])
    assert all(isinstance(m, GroundTruth) and m.world_from_cam is None for m in messages[1::2])


@pytest.mark.slow
def test_a_slow_robot_reader_skips_and_counts(address: str) -> None:
    sender = publish(Publisher(address), [frame(i) for i in range(60)], 0.01)
    robot = Robot(Robot.Config(path=address))
    numbers = []
    for message in robot.run():
        if isinstance(message, Frame):
            numbers.append(int(message.image[0, 0, 0]))
            time.sleep(0.1)
    sender.join()
    assert numbers[-1] == 59  # the newest is never dropped
    assert len(numbers) < 30
    assert robot.stats.counts["dropped"] == numbers[-1] - numbers[0] + 1 - len(numbers)


@pytest.mark.slow
def test_a_robot_that_falls_silent_or_never_speaks(address: str) -> None:
    with pytest.raises(TimeoutError, match=r"examples/robot\.py"):
        list(Robot(Robot.Config(path=address, timeout=0.3)).run())
    publisher = Publisher(address)
    try:
        robot = Robot(Robot.Config(path=address, timeout=0.6))
        stream = robot.run()
        sender = threading.Thread(target=lambda: [_wait(publisher), publisher.send(frame(3))])
        sender.start()
        assert len(list(stream)) == 2
        sender.join()
        assert any("the stream ends here" in w for w in robot.stats.warnings)
    finally:
        publisher.close()


def _wait(publisher: Publisher) -> None:
    while not publisher.ready(1):
        time.sleep(0.01)


@pytest.mark.slow
def test_what_a_robot_should_not_send_is_left_out(address: str) -> None:
    wrong_type = Depth(
        1, 0.1, np.zeros((4, 4, 3), np.uint8), np.ones(4), np.eye(4), 1.0,
        np.ones((4, 4), np.float32), np.ones((4, 4), np.float32), 0,
    )  # fmt: skip
    odd = [frame(0), wrong_type, frame(2, (32, 32)), frame(3, focal=-1.0), frame(4, focal=float("nan")), frame(5)]
    sender = publish(Publisher(address), odd, 0.25)
    robot = Robot(Robot.Config(path=address, timeout=5.0))
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
        robot = Robot(Robot.Config(path=address, timeout=30.0))
        numbers = [int(m.image[0, 0, 0]) for m in robot.run() if isinstance(m, Frame)]
        output, errors = example.communicate(timeout=20)
    assert example.returncode == 0, errors
    assert numbers[-1] == 25
    assert numbers == sorted(set(numbers))
    assert "6 frames sent" in output
    assert "warning: frames without a depth map" in errors
