"""A live camera, which drops pictures and is lost and found; a fake one, and a network camera on loopback."""

from __future__ import annotations

import http.server
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import nodes.camera
import nodes.stream_presence
from msgs import Frame, GroundTruth
from mvsgs_core.datasets.lens import guess_lens
from mvsgs_core.stats import Stats
from nodes.camera import Camera, CameraError
from nodes.stream_presence import Presence, pauses
from tests.support.fake_camera import FakeCapture, capture
from tests.support.patience import until

__all__ = ["capture"]  # the fixture


def test_camera_delivers_frames_with_guessed_intrinsics(capture: type[FakeCapture]) -> None:
    camera = Camera(Camera.Config(start=2, stop=8, stride=2, size=[24, 32]))
    began = time.time_ns()
    messages = list(camera.run())
    assert [type(m) for m in messages] == [Frame, GroundTruth] * 3
    assert all(began <= m.stamp <= time.time_ns() for m in messages[::2])
    assert [m.index for m in messages] == [0, 0, 1, 1, 2, 2]
    assert messages[0].image.shape == (24, 32, 3)
    assert messages[0].image[0, 0, 1] == 0  # RGB
    assert messages[0].image[0, 0, 0] > 0
    assert messages[0].intrinsics[2] == 15.5
    assert messages[0].intrinsics_guessed
    assert messages[0].original_intrinsics == pytest.approx(guess_lens((48, 64)).intrinsics)
    assert messages[1].world_from_cam is None
    assert any("guess" in w for w in camera.stats.warnings)


def test_a_slow_reader_gets_the_newest_picture_and_the_rest_is_counted(capture: type[FakeCapture]) -> None:
    camera = Camera(Camera.Config(stop=5, intrinsics=[50, 50, 31.5, 23.5]))
    seen: list[int] = []
    for message in camera.run():
        if isinstance(message, Frame):
            seen.append(int(message.image[0, 0, 0]))
            capture.gate.release(14)  # with the one that came as this was taken, 15 meanwhile
            until(lambda: camera._feed.dropped == 14 * len(seen))
    assert camera.stats.warnings == []
    assert camera.stats.counts["frames"] == 5
    assert seen == [1, 16, 31, 46, 61]  # never an old picture
    assert camera.stats.counts["dropped"] == 4 * 14


@pytest.mark.parametrize(("path", "asked"), [("2", (2,)), ("/dev/video2", (2,)), ("rtsp://host/2", ("rtsp://host/2",))])
def test_a_device_is_opened_by_its_number(
    path: str, asked: tuple[object, ...], capture: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV opens none by its name where it is given limits of time."""
    opened: list[tuple[object, ...]] = []
    begin = capture.__init__

    def noted(self: FakeCapture, *arguments: object) -> None:
        opened.append(arguments)
        begin(self, *arguments)

    monkeypatch.setattr(capture, "__init__", noted)
    assert list(Camera(Camera.Config(path=path, stop=1)).run())
    assert opened[0][:1] == asked
    assert (len(opened[0]) == 1) == isinstance(asked[0], int)


@pytest.mark.skipif(sys.platform != "linux", reason="devices have other names")
def test_a_device_that_does_not_exist_is_named() -> None:
    for path in ("77", "/dev/video77"):
        with pytest.raises(CameraError, match=f"camera {path}: /dev/video77 does not exist"):
            Camera.check(Camera.Config(path=path))


def test_a_password_is_in_no_message(capture: type[FakeCapture]) -> None:
    capture.dead_after = 1
    camera = Camera(Camera.Config(path="rtsp://me:secret@host/2", timeout=0.3))
    list(camera.run())
    assert any("camera rtsp://host/2 gave no usable picture" in text for text in camera.stats.warnings)
    with pytest.raises(CameraError, match="camera rtsp://host/2 cannot be opened"):
        list(camera.run())
    assert "secret" not in "".join(camera.stats.warnings)


def told(camera: Camera, text: str) -> list[str]:
    return [warning for warning in camera.stats.warnings if text in warning]


def test_a_camera_that_comes_back_goes_on_and_both_are_told_at_once(capture: type[FakeCapture]) -> None:
    capture.lost_after = 4
    camera = Camera(Camera.Config(stop=10))
    lost: list[int] = []  # warnings of it at each frame
    began = time.monotonic()
    for message in camera.run():
        if isinstance(message, Frame):
            lost.append(len(told(camera, "camera 0 was lost")))
    took = time.monotonic() - began
    assert (lost[:2], lost[4:6], lost[8:]) == ([0, 0], [1, 1], [2, 2])
    away, back = told(camera, "loss 1")
    assert away == "camera 0 was lost (it gives no picture; loss 1): it is waited for up to 30 s"
    assert re.fullmatch(r"camera 0 is back after \d+\.\d s \(loss 1\)", back)
    assert camera.stats.counts["frames"] == 10
    assert camera.stats.counts["lost"] == 2
    assert 0 < camera.stats.counts["seconds_lost"] < took


@pytest.mark.slow
def test_it_is_tried_again_at_growing_pauses_until_its_timeout(
    capture: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nodes.stream_presence, "FIRST_PAUSE", 0.02)
    capture.dead_after = 3
    waited: list[float] = []

    class Noted(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            assert timeout is not None
            waited.append(timeout)
            return super().wait(0.01)

    parts = SimpleNamespace(Event=Noted, Condition=threading.Condition, Thread=threading.Thread)
    monkeypatch.setattr(nodes.camera, "threading", parts)
    camera = Camera(Camera.Config(timeout=1.2))
    list(camera.run())
    assert waited[:5] == pytest.approx([0.02, 0.04, 0.08, 0.16, 0.3])
    assert set(waited[5:]) <= {0.3}  # a quarter of the timeout
    assert len(waited) - capture.opened in (-1, 0)  # the last one may have been for the end
    assert camera.stats.warnings[-1] == "camera 0 gave no usable picture for 1.2 s: the stream ends here"
    assert camera.stats.counts["lost"] == 1


def test_pauses_double_up_to_a_bound() -> None:
    def first(timeout_s: float) -> list[float]:
        return [pause for _, pause in zip(range(7), pauses(timeout_s))]

    assert first(60.0) == [0.25, 0.5, 1.0, 2.0, 2.0, 2.0, 2.0]
    assert first(4.0) == [0.25, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0]


def test_a_camera_of_another_size_is_refused_until_it_has_its_own_again(capture: type[FakeCapture]) -> None:
    asked: list[tuple[int, float]] = []
    read = capture.read
    capture.lost_after = 4

    def other(self: FakeCapture) -> tuple[bool, np.ndarray | None]:
        good, picture = read(self)
        if good and picture is not None and capture.opened == 2:
            picture = picture[:24]
        return good, picture

    def noted(self: FakeCapture, name: int, value: float) -> bool:
        asked.append((name, value))
        return True

    capture.read, capture.set = other, noted  # type: ignore[method-assign, assignment]
    camera = Camera(Camera.Config(stop=7))
    frames = [message for message in camera.run() if isinstance(message, Frame)]
    assert len(frames) == 7
    assert {frame.image.shape for frame in frames} == {(48, 64, 3)}
    assert camera.stats.counts["other_size"] == camera.stats.counts["unusable"] == 4
    assert told(camera, "frames of another size than the first, (48, 64), were left out, such as (24, 64)")
    assert (cv2.CAP_PROP_FRAME_HEIGHT, 48) in asked  # as it was before it was lost


def test_a_picture_that_is_given_again_is_counted_and_refused(capture: type[FakeCapture]) -> None:
    read = capture.read

    def stuck(self: FakeCapture) -> tuple[bool, np.ndarray | None]:
        good, picture = read(self)
        return good, None if picture is None else np.full_like(picture, int(picture.max()) // 4)

    capture.read = stuck  # type: ignore[method-assign]
    camera = Camera(Camera.Config(stop=4))
    frames = [message for message in camera.run() if isinstance(message, Frame)]
    assert [int(frame.image.max()) for frame in frames] == [0, 1, 2, 3]  # a picture that stands still is no lost camera
    assert camera.stats.counts["doubled"] == 2 + 3 + 3


def test_a_clock_that_is_set_does_not_move_the_stream(
    capture: type[FakeCapture], monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = time.time
    monkeypatch.setattr(nodes.camera.time, "time", lambda: wall() - 3600 * (capture.pictures > 3))
    times = [message.timestamp for message in Camera(Camera.Config(stop=8)).run() if isinstance(message, Frame)]
    assert all(0 < b - a < 5 for a, b in pairwise(times))
    assert abs(times[0] - wall()) < 60


@pytest.mark.slow
def test_a_camera_that_hangs_is_told_before_it_is_given_up(capture: type[FakeCapture]) -> None:
    read = capture.read

    def hanging(self: FakeCapture) -> tuple[bool, np.ndarray | None]:
        if capture.pictures in (3, 4):
            until(lambda: told(camera, f"loss {capture.pictures - 2}"))  # and then it comes to itself, for one picture
        return read(self)

    capture.read = hanging  # type: ignore[method-assign]
    camera = Camera(Camera.Config(timeout=2.0, stop=5))
    assert sum(isinstance(message, Frame) for message in camera.run()) == 5
    assert told(camera, "camera 0 was lost (nothing came for 1 s; loss 1): it is waited for up to 2 s")
    assert told(camera, "camera 0 is back after ")
    assert camera.stats.counts["lost"] == 2


def test_a_stream_of_few_frames_is_no_lost_one() -> None:
    now = [0.0]

    def at(clock: float, action: Callable[[], Any]) -> int:
        now[0] = clock
        action()
        return int(stats.counts.get("lost", 0))

    stats = Stats()
    presence = Presence(stats, "it", 60.0, lambda: now[0])
    assert at(50.0, lambda: presence.wait(0.0)) == 0  # the first may take its time
    assert at(50.0, presence.came) == 0
    assert at(54.0, presence.came) == 0  # a frame every 4 s
    assert at(60.0, lambda: presence.wait(54.0)) == 0
    assert at(74.0, lambda: presence.wait(54.0)) == 1
    assert at(80.0, lambda: presence.wait(54.0)) == 1  # said once
    assert at(84.0, presence.came) == 1
    assert list(stats.warnings) == [
        "it was lost (nothing came for 20 s; loss 1): it is waited for up to 60 s",
        "it is back after 10.0 s (loss 1)",
    ]
    assert stats.counts["seconds_lost"] == 10.0


def test_a_camera_that_dies_ends_the_stream_and_not_the_run(capture: type[FakeCapture]) -> None:
    capture.dead_after = 3
    camera = Camera(Camera.Config(timeout=0.3))
    messages = list(camera.run())
    assert 2 <= len(messages) <= 6
    assert "camera 0 gave no usable picture for 0.3 s: the stream ends here" in camera.stats.warnings


def test_a_camera_that_is_not_there(capture: type[FakeCapture], tmp_path: Path) -> None:
    capture.dead_after = 0
    with pytest.raises(CameraError, match="camera 7 cannot be opened: is it connected"):
        list(Camera(Camera.Config(path="7")).run())
    with pytest.raises(CameraError, match="rtsp://nowhere/x cannot be opened: is the address right"):
        list(Camera(Camera.Config(path="rtsp://nowhere/x")).run())
    capture.dead_after, capture.lost_after = None, 0
    with pytest.raises(TimeoutError, match=r"gave no usable picture for 0\.2 s: camera 0 was lost"):
        list(Camera(Camera.Config(timeout=0.2)).run())
    (tmp_path / "walk.mp4").touch()
    with pytest.raises(CameraError, match="dataset=video"):
        list(Camera(Camera.Config(path=str(tmp_path / "walk.mp4"))).run())


def test_a_camera_that_opens_and_never_answers(capture: type[FakeCapture]) -> None:
    capture.gate.acquire()
    with pytest.raises(TimeoutError, match=r"no usable picture for 0\.2 s: it was opened, but gives none"):
        list(Camera(Camera.Config(timeout=0.2)).run())


class Stream(http.server.BaseHTTPRequestHandler):
    """Motion JPEG, as network cameras send it: 20 pictures, then silence before the connection ends."""

    silence = 3.0  # s

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
            time.sleep(self.silence)
        except ConnectionError:
            pass  # the reader left

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving(handler: type[http.server.BaseHTTPRequestHandler]) -> Iterator[str]:
    """The address of a network camera."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/video.mjpg"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.slow
def test_a_network_camera_whose_stream_drops_goes_on() -> None:
    class Dropping(Stream):
        silence = 0.0

    with serving(Dropping) as address:
        camera = Camera(Camera.Config(path=address, timeout=8.0, stop=25))
        frames = [message for message in camera.run() if isinstance(message, Frame)]
    assert len(frames) == 25  # of connections that give 20 pictures each
    assert camera.stats.counts["lost"] >= 1
    assert told(camera, "is back after")


@pytest.mark.slow
def test_a_network_camera_that_falls_silent() -> None:
    with serving(Stream) as address:
        camera = Camera(Camera.Config(path=address, timeout=1.5))
        began = time.monotonic()
        values = [int(message.image[0, 0, 0]) for message in camera.run() if isinstance(message, Frame)]
        assert time.monotonic() - began < 8
    assert len(values) > 10
    assert values == sorted(values)
    assert told(camera, "gave no usable picture for 1.5 s: the stream ends here")
    assert told(camera, "was lost (")


def test_the_address_of_a_video_file_is_refused_as_it_would_begin_anew_for_ever(tmp_path: Path) -> None:
    file = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (64, 48))
    for number in range(20):
        writer.write(np.full((48, 64, 3), 10 * number, dtype=np.uint8))
    writer.release()

    class Folder(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(file.stat().st_size))
            self.end_headers()
            self.wfile.write(file.read_bytes())

        def log_message(self, *_: object) -> None:
            pass

    with serving(Folder) as address, pytest.raises(CameraError, match=r"which ends, .* downloaded if need be"):
        list(Camera(Camera.Config(path=address, timeout=3.0, stop=5)).run())


@pytest.mark.parametrize("path", ["rtsp://host/film", "/data/%03d.jpg", "concat:walk.mp4"])
def test_whatever_has_a_last_frame_is_no_camera(capture: type[FakeCapture], path: str) -> None:
    capture.count = 900.0
    with pytest.raises(CameraError, match="is a video file, which ends"):
        list(Camera(Camera.Config(path=path, timeout=0.3)).run())


@pytest.mark.parametrize("count", [-1.0, 0.0, -2.8e11, 2.0**62, float("nan")])
def test_a_stream_whose_frames_nobody_can_count_is_a_camera(capture: type[FakeCapture], count: float) -> None:
    capture.count, capture.dead_after = count, 3
    assert [m for m in Camera(Camera.Config(path="rtsp://host/2", timeout=0.3)).run() if isinstance(m, Frame)]


@pytest.mark.parametrize("scheme", ["file://", "file:", "FILE://"])
def test_the_address_of_a_file_is_refused_before_anything_starts(scheme: str) -> None:
    with pytest.raises(CameraError, match=r"is a file and no camera: use dataset=video dataset.path=/data/walk\.mp4"):
        Camera.check(Camera.Config(path=f"{scheme}/data/walk.mp4"))


LARGE = [2800.0, 2800.0, 1919.5, 1079.5]  # of 3840x2160


def test_intrinsics_of_a_camera_of_any_size_are_taken(capture: type[FakeCapture]) -> None:
    address = "rtsp://host/stream"
    Camera.check(Camera.Config(path=address, intrinsics=LARGE))
    Camera.check(Camera.Config(path=address, intrinsics=LARGE, resolution=[2160, 3840]))
    for wrong in ([2800.0, 2800.0, float("nan"), 1079.5], [-1.0, 2800.0, 1919.5, 1079.5], [2800.0, 2800.0, 1919.5]):
        with pytest.raises(ValueError, match=r"intrinsics|focal"):
            Camera.check(Camera.Config(path=address, intrinsics=wrong))
    with pytest.raises(ValueError, match="far outside of 640x480"):
        Camera.check(Camera.Config(path=address, intrinsics=LARGE, resolution=[480, 640]))
    camera = Camera(Camera.Config(stop=1, intrinsics=[100, 100, 63.5, 47.5]))  # its pictures are of 64x48
    list(camera.run())
    assert any("of another size (about 128x96)" in w for w in camera.stats.warnings)
