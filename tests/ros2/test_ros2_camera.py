"""dataset=ros2: images of another process over DDS, its calibration, what is false in them, and silence."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count, pairwise
from typing import Any

import numpy as np
import pytest
from PIL import Image

from msgs import Frame, GroundTruth
from mvsgs_core.datasets.framing import Framing
from mvsgs_core.datasets.lens import Lens
from nodes.ros2 import messages
from nodes.ros2.cdr import CdrError, encode
from nodes.ros2_camera import Ros2Camera
from tests.support.ros2_images import (
    COMPRESSED,
    IMAGE,
    INFO,
    SIZE,
    K,
    Sender,
    config,
    numbers,
    picture,
    received,
    sender,
    stamp,
)  # fmt: skip
from tests.support.ros2_peer import Peer

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow

_numbers = count()


@pytest.fixture
def camera() -> str:
    """A namespace of its own."""
    return f"/camera_{next(_numbers)}"


def calibrated(node: Ros2Camera, count: int) -> range:
    """Of so many images those that came after their calibration."""
    return range(int(node.stats.counts.get("before_calibration", 0)), count)


def until_killed(send: Sender) -> Callable[[], None]:
    def sending() -> None:
        with suppress(EOFError, OSError):
            send()

    return sending


def test_images_arrive_with_their_times_and_calibration(peer: Peer, camera: str) -> None:
    send = sender(peer, camera, [picture(i) for i in range(20)])
    frames, node = received(config(camera), send)
    assert numbers(frames) == list(calibrated(node, 20))
    assert [frame.index for frame in frames] == list(range(len(frames)))
    for frame, number in zip(frames, numbers(frames), strict=True):
        assert frame.timestamp == pytest.approx(1000 + number / 10, abs=1e-6)
        assert frame.image.shape == (24, 32, 3)
        assert (frame.image == number).all()
        assert frame.intrinsics == pytest.approx([25.0, 25.0, 15.5, 11.5])
        assert not frame.intrinsics_guessed
    assert node.stats.warnings == [
        "the camera was lost (nothing came for 1.5 s; loss 1): it is waited for up to 3 s",
        f"no usable image at {camera}/image_raw for 3 s: the stream ends here",
    ]


def test_ground_truth_is_the_same_image(peer: Peer, camera: str) -> None:
    node = Ros2Camera(config(camera, stop=2))
    send = sender(peer, camera, [picture(i) for i in range(20)])
    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    messages = list(node.run())
    thread.join()
    assert [type(m) for m in messages] == [Frame, GroundTruth] * 2
    for frame, truth in zip(messages[::2], messages[1::2], strict=True):
        assert (frame.image == truth.image).all()
        assert truth.world_from_cam is None


def test_compressed_images(peer: Peer, camera: str) -> None:
    def compressed(i: int) -> dict[str, Any]:
        data = io.BytesIO()
        Image.fromarray(np.full((24, 32, 3), (10 * i, 50, 200), np.uint8)).save(data, "PNG")
        return {"header": stamp(5.0 + i), "format": "png", "data": list(data.getvalue())}

    topic = "image_raw/compressed"
    send = sender(peer, camera, [compressed(i) for i in range(12)], name=COMPRESSED, topic=topic)
    frames, _ = received(config(camera, path=f"{camera}/{topic}"), send, frames=5)
    assert all(frame.image[3, 4].tolist()[1:] == [50, 200] for frame in frames)
    assert frames[0].intrinsics == pytest.approx([25.0, 25.0, 15.5, 11.5])


RGB = (200, 60, 20)


@pytest.mark.parametrize(
    ("encoding", "pixel", "shown"),
    [
        ("rgb8", RGB, RGB), ("bgr8", RGB[::-1], RGB), ("rgba8", (*RGB, 9), RGB), ("bgra8", (*RGB[::-1], 9), RGB),
        ("mono16", (0, 77), (77, 77, 77)), ("yuv422", (128, 90, 128, 90), None),
        ("yuv422_yuy2", (90, 128, 90, 128), None),
    ],
)  # fmt: skip
def test_encodings(
    peer: Peer, camera: str, encoding: str, pixel: tuple[int, ...], shown: tuple[int, int, int] | None
) -> None:
    per_pixel = 2 if encoding.startswith("yuv") else len(pixel)
    row = list(pixel) * (32 * per_pixel // len(pixel))
    message = picture(0, encoding=encoding, step=32 * per_pixel, data=row * 24)
    frames, _ = received(config(camera), sender(peer, camera, [message] * 9), frames=1)
    assert frames[0].image.std(axis=(0, 1)).max() == 0
    if shown is not None:
        assert frames[0].image[5, 5].tolist() == list(shown)
    else:
        assert np.ptp(frames[0].image[5, 5].astype(int)) <= 2  # no color in it: gray


def test_bayer_colors(peer: Peer, camera: str) -> None:
    mosaic = np.zeros((24, 32), np.uint8)
    mosaic[::2, ::2], mosaic[::2, 1::2], mosaic[1::2, ::2], mosaic[1::2, 1::2] = RGB[0], RGB[1], RGB[1], RGB[2]
    message = picture(0, encoding="bayer_rggb8", data=mosaic.ravel().tolist())
    frames, _ = received(config(camera), sender(peer, camera, [message] * 9), frames=1)
    assert frames[0].image[10, 10].tolist() == list(RGB)


@pytest.mark.parametrize(
    ("model", "d"),
    [("plumb_bob", [0.2, 0.05, 0, 0, 0]), ("rational_polynomial", [0.2, 0.05, 0, 0, 0, 0.01, 0, 0]),
     ("equidistant", [1.0, 0.3, 0, 0]), ("fisheye", [1.0, 0.3, 0, 0])],
)  # fmt: skip
def test_distortion_is_taken_out(peer: Peer, camera: str, model: str, d: list[float]) -> None:
    info = INFO | {"distortion_model": model, "d": d}
    gray = np.add.outer(np.arange(24), 7 * np.arange(32)).astype(np.uint8)
    send = sender(peer, camera, [picture(0, data=gray.ravel().tolist())] * 9, info)
    frames, node = received(config(camera, size=[12, 16]), send, frames=1)
    lens = Lens((25.0, 25.0, 15.5, 11.5), SIZE, tuple(map(float, d)), fisheye=len(d) == 4)
    image, intrinsics = Framing([12, 16]).image(np.repeat(gray[..., None], 3, axis=2), lens, (12, 16))
    assert (frames[0].image == image).all()
    assert frames[0].intrinsics == pytest.approx(intrinsics)
    assert intrinsics[0] > 1.02 * 12.5  # it is zoomed to hide the border
    assert not node.stats.warnings


def test_rectified_images_have_the_projection_of_their_calibration(peer: Peer, camera: str) -> None:
    p = [30.0, 0, 16.0, 0, 0, 31.0, 12.0, 0, 0, 0, 1, 0]
    info = INFO | {"d": [-0.2, 0.05, 0, 0, 0], "p": p}
    send = sender(peer, camera, [picture(i) for i in range(9)], info, topic="image_rect")
    frames, _ = received(config(camera, path=f"{camera}/image_rect"), send, frames=1)
    assert frames[0].intrinsics == pytest.approx([30.0, 31.0, 16.0, 12.0])


def test_without_calibration_the_focal_length_is_guessed_and_said(peer: Peer, camera: str) -> None:
    send = sender(peer, camera, [picture(i) for i in range(40)], info=None)
    frames, node = received(config(camera, info_timeout=0.5), send)
    assert frames[0].intrinsics_guessed
    assert node.stats.counts["before_calibration"] >= 5
    text = "\n".join(node.stats.warnings)
    assert f"no calibration came at {camera}/camera_info in 0.5 s" in text
    assert "intrinsics are a guess" in text


@pytest.mark.parametrize("change", [{"k": [27.0, *K[1:]]}, {"d": [0.1, 0, 0, 0, 0]}])
def test_a_calibration_that_changes_is_said_once_and_the_first_one_holds(
    peer: Peer, camera: str, change: dict[str, Any]
) -> None:
    send = sender(peer, camera, [picture(i) for i in range(20)], later=(10, INFO | change))
    frames, node = received(config(camera), send)
    assert all(frame.intrinsics == pytest.approx([25.0, 25.0, 15.5, 11.5]) for frame in frames)
    (told,) = [text for text in node.stats.warnings if "calibration" in text]
    assert f"the calibration at {camera}/camera_info changed while the stream ran" in told
    assert "start again after each change" in told


def test_a_calibration_that_comes_after_the_guess_is_said_with_what_to_do(peer: Peer, camera: str) -> None:
    send = sender(peer, camera, [picture(i) for i in range(40)], info=None, later=(35, INFO))
    frames, node = received(config(camera, info_timeout=0.5), send)
    assert all(frame.intrinsics_guessed for frame in frames)
    (told,) = [text for text in node.stats.warnings if "after the focal length was guessed" in text]
    assert "start again" in told
    assert "dataset.info_timeout" in told


def test_calibration_of_a_camera_that_nobody_calibrated_and_of_none(peer: Peer, camera: str) -> None:
    send = sender(peer, camera, [picture(i) for i in range(40)], INFO | {"k": [0.0] * 9})
    frames, node = received(config(camera, info_timeout=0.5), send)
    assert frames[0].intrinsics_guessed
    assert any("is empty: the camera was not calibrated" in text for text in node.stats.warnings)


@pytest.mark.parametrize(
    "change", [{"k": [float("nan"), *K[1:]], "height": 24}, {"k": [1e300, *K[1:]]}, {"distortion_model": "tarot"},
               {"d": [float("inf")] * 5}, {"d": [0.1] * 7}]
)  # fmt: skip
def test_a_calibration_that_no_camera_has_is_refused(peer: Peer, camera: str, change: dict[str, Any]) -> None:
    send = sender(peer, camera, [picture(i) for i in range(40)], INFO | change)
    frames, node = received(config(camera, info_timeout=0.5), send)
    assert frames[0].intrinsics_guessed
    assert all(text.isprintable() for text in node.stats.warnings)
    refused = node.stats.counts.get("refused_calibrations", 0)
    assert refused or any("is empty" in text for text in node.stats.warnings)


def test_images_smaller_than_their_calibration_keep_their_size(camera: str) -> None:
    node = Ros2Camera(config(camera))
    node._lens = Lens((50.0, 50.0, 31.5, 23.5), (48, 64))
    shown = node._framed(Frame(0, 1.0, np.zeros((*SIZE, 3), np.uint8), np.array([25.0, 25.0, 15.5, 11.5])))
    assert shown.image.shape == (*SIZE, 3)
    assert shown.intrinsics == pytest.approx([25.0, 25.0, 15.5, 11.5])


def test_intrinsics_that_are_given_hold(peer: Peer, camera: str) -> None:
    send = sender(peer, camera, [picture(i) for i in range(9)])
    frames, _ = received(config(camera, intrinsics=[40.0, 41.0, 15.0, 11.0]), send, frames=1)
    assert frames[0].intrinsics == pytest.approx([40.0, 41.0, 15.0, 11.0])


def test_stamps_stay_the_senders_where_its_clock_is_set(camera: str) -> None:
    node = Ros2Camera(config(camera, intrinsics=[25.0, 25.0, 15.5, 11.5]))
    node._open()
    times = [*range(1_790_000_000, 1_790_000_010), *range(1_000_000_000, 1_000_000_010)]
    taken = []
    for number, seconds in enumerate(times):
        header = messages.Header(messages.Time(seconds, 123_456_789), "camera")
        frame = node._frame(encode(messages.Image(header, 24, 32, "mono8", 0, 32, np.full(24 * 32, number, np.uint8))))
        assert frame is not None
        if (usable := node._frames.accept(frame)) is not None:
            taken.append(usable)
            assert usable.stamp == seconds * 10**9 + 123_456_789
    assert taken[-1].stamp < taken[0].stamp < 10**9 * taken[-1].timestamp  # the stream's time goes on


def test_what_is_false_is_counted_and_the_stream_goes_on(peer: Peer, camera: str) -> None:
    good = [picture(i) for i in range(40)]
    header = messages.Header(messages.Time(1000, 500_000_000), "camera")
    image = messages.Image(header, 24, 32, "mono8", 0, 32, np.full(24 * 32, 5, np.uint8))
    not_text = encode(image).replace(b"mono8", b"mon\xff8")
    false: dict[int, Any] = {
        5: not_text,  # what is no CDR at all Cyclone does not even deliver
        9: picture(9, encoding="32FC1"),
        11: picture(11, data=[11] * 100),
        13: picture(13, size=(48, 64)),
        15: picture(15, size=(24, 24)),
        17: picture(17, size=(2, 2)),
        19: picture(19, encoding="\x1b[31m"),
        21: picture(21, height=2**31, width=2**31),
    }
    sent = [false.get(i, each) for i, each in enumerate(good)]
    frames, node = received(config(camera), sender(peer, camera, sent, interval=0.05))
    assert numbers(frames) == [
        i for i in range(int(node.stats.counts.get("before_calibration", 0)), 40) if i not in false
    ]
    assert node.stats.counts["refused_messages"] == 1
    assert node.stats.counts["unusable"] == len(false) - 1
    assert all(text.isprintable() for text in node.stats.warnings)


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 60, bytes(1000)])
def test_what_is_no_message_is_refused(camera: str, data: bytes) -> None:
    node = Ros2Camera(config(camera))
    node._open()
    assert node._frame(data) is None
    assert node.stats.counts == {"refused_messages": 1}
    with pytest.raises(CdrError):
        node._images.decode(data)


def test_frames_at_times_that_go_back_or_leap_are_refused(peer: Peer, camera: str) -> None:
    odd = {5: 0.0, 8: 3.0, 12: 2e9}
    frames, node = received(config(camera), sender(peer, camera, [picture(i, odd.get(i)) for i in range(20)]))
    assert numbers(frames) == [
        i for i in range(int(node.stats.counts.get("before_calibration", 0)), 20) if i not in odd
    ]
    assert all(b.timestamp > a.timestamp for a, b in pairwise(frames))
    assert node.stats.counts["out_of_order"] == 2  # that of no time at all is unusable otherwise
    assert "times_repaired" not in node.stats.counts


def test_a_reader_that_is_slow_gets_the_newest_and_counts(peer: Peer, camera: str) -> None:
    node = Ros2Camera(config(camera, queue=5))
    send = sender(peer, camera, [picture(i) for i in range(40)], interval=0.02)
    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    taken = []
    for message in node.run():
        if isinstance(message, Frame):
            taken.append(int(message.image[0, 0, 0]))
            time.sleep(0.2)
    thread.join()
    assert taken[-1] == 39
    assert len(taken) < 20
    assert node.stats.counts["dropped"] >= len(taken)


def test_a_program_that_is_killed_and_starts_again_goes_on(camera: str) -> None:
    first = Peer()
    send = sender(first, camera, [picture(i) for i in range(100, 200)])
    node = Ros2Camera(config(camera, timeout=15.0))
    threading.Thread(target=until_killed(send), daemon=True).start()
    taken: list[int] = []
    again: Peer | None = None
    for message in node.run():
        if not isinstance(message, Frame):
            continue
        taken.append(int(message.image[0, 0, 0]))
        if again is None and taken[-1] >= 105:
            first.kill()
            again = Peer()
            threading.Thread(
                target=sender(again, camera, [picture(i, 2000.0 + i) for i in range(20)]), daemon=True
            ).start()
        if taken[-1] == 19:
            break
    assert again is not None
    again.close()
    assert taken[-1] == 19


def test_a_program_that_ends_is_said_to_be_lost_and_so_is_its_return(camera: str) -> None:
    node = Ros2Camera(config(camera, timeout=20.0, stop=15))
    programs = [Peer(), Peer()]

    def one_after_the_other() -> None:
        for number, program in enumerate(programs):
            start = 100 * number
            sender(program, camera, [picture(start + i, 1000.0 + start + i / 10) for i in range(10)])()
            program.close()

    thread = threading.Thread(target=one_after_the_other, daemon=True)
    thread.start()
    taken = [message for message in node.run() if isinstance(message, Frame)]
    assert numbers(taken)[0] < 10 <= 100 <= numbers(taken)[-1]
    lost, back = (text for text in node.stats.warnings if "loss 1" in text)
    assert lost == "the camera was lost (nobody publishes its images any more; loss 1): it is waited for up to 20 s"
    assert back.startswith("the camera is back after")
    assert node.stats.counts["lost"] == 1


def test_nobody_there_is_said_with_what_to_do(camera: str) -> None:
    with pytest.raises(TimeoutError, match="ROS_LOCALHOST_ONLY=1"):
        list(Ros2Camera(config(camera, timeout=0.5)).run())


def test_a_reader_that_wants_more_than_is_offered_is_told_so(peer: Peer, camera: str) -> None:
    peer.advertise(f"{camera}/image_raw", IMAGE, reliable=False)
    with pytest.raises(TimeoutError, match=r"ros2 topic info|nobody publishes"):
        list(Ros2Camera(config(camera, timeout=1.0, reliable=True)).run())
