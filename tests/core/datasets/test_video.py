"""Video files."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import check, open_dataset
from tests.support.dataset_folders import truncate

FRAMES, RATE = 30, 20.0


@pytest.fixture(params=[("avi", "MJPG"), ("mp4", "mp4v")])
def video(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Frame i is gray 8 i, blue a little darker."""
    suffix, code = request.param
    path = tmp_path / f"walk.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), RATE, (64, 48))
    assert writer.isOpened()
    for i in range(FRAMES):
        writer.write(np.full((48, 64, 3), (max(0, 8 * i - 40), 8 * i, 8 * i), dtype=np.uint8))
    writer.release()
    return path


def test_frames_and_timestamps(video: Path) -> None:
    sequence = open_dataset("video", path=video, intrinsics=[50, 51, 31.5, 23.5])
    for _ in range(2):
        items = list(sequence)
        assert len(sequence) == len(items) == FRAMES
        assert [item.index for item in items] == list(range(FRAMES))
        np.testing.assert_allclose([item.timestamp for item in items], np.arange(FRAMES) / RATE, atol=1e-3)
        np.testing.assert_allclose([item.image[..., 0].mean() for item in items], 8 * np.arange(FRAMES), atol=6)
        assert items[20].image[..., 2].mean() < items[20].image[..., 0].mean() - 20  # RGB
        np.testing.assert_allclose(items[0].intrinsics, [50, 51, 31.5, 23.5])
        assert items[0].world_from_cam is None
        assert items[0].depth is None
        assert sequence.warnings == []


def test_selection_and_size(video: Path) -> None:
    sequence = open_dataset("video", path=video, intrinsics="auto", start=3, stop=20, stride=4, size=(24, 32))
    assert all(item.intrinsics_guessed for item in sequence)
    items = list(sequence)
    assert len(sequence) == len(items) == 5
    np.testing.assert_allclose([item.timestamp for item in items], [0.15, 0.35, 0.55, 0.75, 0.95], atol=1e-3)
    assert items[0].image.shape == (24, 32, 3)
    assert items[0].intrinsics[2] == 15.5
    assert "65 degrees" in sequence.warnings[0]
    with pytest.raises(ValueError, match="no frame left"):
        open_dataset("video", path=video, intrinsics="auto", start=FRAMES)


def test_a_camera_must_be_given_or_guessed_knowingly(video: Path) -> None:
    with pytest.raises(ValueError, match="intrinsics=auto"):
        open_dataset("video", path=video)


def test_a_video_that_is_cut_off_goes_as_far_as_it_can(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (160, 120))
    noise = np.random.default_rng(0)
    for _ in range(FRAMES):
        writer.write(noise.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    writer.release()
    truncate(path, 0.5)
    sequence = open_dataset("video", path=path, intrinsics="auto")
    items = list(sequence)
    assert 5 < len(items) < 25
    assert any(w.endswith("it is cut off or damaged") for w in sequence.warnings)
    list(sequence)
    assert sum("cut off" in w for w in sequence.warnings) == 1


def test_what_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="cannot open"):
        open_dataset("video", path=path, intrinsics="auto")


class Container:
    """A capture whose container promises `count` frames, of which `there` can be read, at `rate` a second."""

    count, there, rate, stretch = 30, 30, 20.0, 1.0

    def __init__(self, _: str) -> None:
        self.number = 0

    def isOpened(self) -> bool:
        return True

    def release(self) -> None:
        pass

    def get(self, what: int) -> float:
        milliseconds = 1e3 * self.stretch * (self.number - 1) / self.rate
        known = {cv2.CAP_PROP_FRAME_COUNT: self.count, cv2.CAP_PROP_FPS: self.rate}
        return float(known.get(what, milliseconds))

    def grab(self) -> bool:
        self.number += 1
        return self.number <= self.there

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((48, 80 if self.number == 7 else 64, 3), np.uint8)

    def read(self) -> tuple[bool, np.ndarray]:
        return self.grab(), self.retrieve()[1]


@pytest.mark.parametrize(
    ("count", "there", "stretch", "damaged"),
    [
        (30, 30, 1.0, False),
        (30, 29, 1.0, False),  # off by one, as short mp4 files are
        (30, 28, 1.0, False),
        (30, 26, 1.0, True),
        (3000, 2980, 1.0, False),  # a percent
        (3000, 2900, 1.0, True),
        (3000, 2000, 1.5, False),  # the count is the duration times a rate that is not kept: all of the time is there
    ],
)
def test_a_frame_count_is_an_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int, there: int, stretch: float, damaged: bool
) -> None:
    kind = type("Promising", (Container,), {"count": count, "there": there, "stretch": stretch})
    monkeypatch.setattr(cv2, "VideoCapture", kind)
    (tmp_path / "walk.mp4").touch()
    sequence = open_dataset("video", path=tmp_path / "walk.mp4", intrinsics=[50, 50, 31.5, 23.5])
    assert len(list(sequence)) == there - 1, "the one of another shape is left out"
    assert any("could not be decoded: 1 (first: frame 6: 80x48 after 64x48)" in w for w in sequence.warnings)
    assert any("cut off" in w for w in sequence.warnings) == damaged
    stopped = open_dataset("video", path=tmp_path / "walk.mp4", intrinsics=[50, 50, 31.5, 23.5], stop=20)
    assert len(list(stopped)) == 19
    assert not any("cut off" in w for w in stopped.warnings)


def test_a_video_without_its_index_says_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (64, 48))
    for _ in range(FRAMES):
        writer.write(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    truncate(path, 0.5)
    with pytest.raises(BadFileError, match=r"walk\.mp4.*cut off before its index was written"):
        check("video", path=path, intrinsics="auto")


def test_a_video_whose_name_is_no_utf_8_is_not_given_to_opencv(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"walk\xe9.mp4")  # OpenCV ends the process
    path.write_bytes(b"no video")
    with pytest.raises(BadFileError, match=r"walk\\udce9\.mp4: this name is no valid UTF-8; rename it"):
        check("video", path=path, intrinsics="auto")


def test_hdr_is_mapped_and_said(tmp_path: Path) -> None:
    """White paper is 75 % of HLG's signal (ITU-R BT.2408), mid gray 38 %; as a photograph's they are 191 and 97."""
    path = tmp_path / "phone.mov"
    with av.open(path, "w") as container:
        stream = container.add_stream("libx265", rate=10)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p10le"
        stream.options = {"x265-params": "log-level=none:colorprim=9:transfer=18:colormatrix=9"}
        gray = np.full((64, 128, 3), int(0.38 * 65535), np.uint16)
        gray[:, 64:] = int(0.75 * 65535)
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(gray, format="rgb48le")
            frame = frame.reformat(format="yuv420p10le", dst_colorspace=9)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    sequence = open_dataset("video", path=path, intrinsics=[100, 100, 63.5, 31.5])
    assert any("HDR video (HLG)" in warning for warning in sequence.warnings)
    image = next(iter(sequence)).image
    assert image[:, 80:].min() > 230, "white paper is white"
    assert 97 < image[:, :48].mean() < 135


def test_a_video_turned_by_its_metadata_is_upright(tmp_path: Path) -> None:
    path = tmp_path / "phone.mp4"
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.set_display_rotation(90)  # counterclockwise, as players show it
        picture = np.zeros((64, 96, 3), np.uint8)
        picture[:, :48, 0] = 255
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    image = next(iter(open_dataset("video", path=path, intrinsics=[80, 80, 31.5, 47.5]))).image
    assert image.shape == (96, 64, 3)
    assert image[60:, :, 0].min() > 200 > 60 > image[:36, :, 0].max(), "what was left is below"


@pytest.mark.parametrize(
    ("matrix", "shown"),  # where a step to the right goes, and one down
    [
        ((-1, 0, 0, 1), lambda picture: picture[:, ::-1]),
        ((1, 0, 0, -1), lambda picture: picture[::-1]),
        ((0, 1, 1, 0), lambda picture: picture.transpose(1, 0, 2)),
        ((0, -1, -1, 0), lambda picture: picture[::-1, ::-1].transpose(1, 0, 2)),
    ],
)
def test_a_video_mirrored_by_its_metadata_is_as_players_show_it(
    matrix: tuple[int, ...], shown: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "phone.mp4"
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:32, :48], picture[:32, 48:], picture[32:, :48] = 80, 160, 240  # no two quarters alike
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    content = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in matrix)
    begin = content.index(b"tkhd") + 44  # of the matrix, ISO/IEC 14496-12
    content[begin : begin + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    sequence = open_dataset("video", path=path, intrinsics="auto")
    assert any("mirrored by its metadata" in warning for warning in sequence.warnings)
    for item in sequence:
        assert np.mean(np.abs(item.image.astype(int) - shown(picture))) < 4


@pytest.mark.parametrize("turned", [False, True])
def test_pixels_that_are_not_square(turned: bool, tmp_path: Path) -> None:
    path = tmp_path / "anamorphic.mp4"
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)  # shown as 128x64
        stream.set_display_rotation(90 if turned else 0)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 96, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    sequence = open_dataset("video", path=path, intrinsics="auto")
    focal = 64 / np.tan(np.radians(32.5))  # of square pixels, 128 of them across the longer side
    expected = [focal, 0.75 * focal, 31.5, 47.5] if turned else [0.75 * focal, focal, 47.5, 31.5]
    np.testing.assert_allclose(next(iter(sequence)).intrinsics, expected, atol=1e-9)
    assert any("pixels that are not square" in w and "fy is" in w for w in sequence.warnings)
    given = open_dataset("video", path=path, intrinsics=[80, 81, 31.5, 31.5])
    np.testing.assert_allclose(next(iter(given)).intrinsics, [80, 81, 31.5, 31.5])


def test_the_sharpest_of_each_group(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (160, 120))
    sharp = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    for i in range(11):
        writer.write(sharp if i in (2, 5, 7, 10) else cv2.GaussianBlur(sharp, None, 3.0))
    writer.release()
    sequence = open_dataset("video", path=path, intrinsics="auto", stride=4, sharpest=True)
    items = list(sequence)
    assert len(items) == len(sequence) == 3
    np.testing.assert_allclose([item.timestamp * RATE for item in items], [2, 5, 10], atol=1e-3)
    assert [item.index for item in items] == [0, 1, 2]


def test_4k_is_processed_at_a_size_that_fits(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (3840, 2160))
    writer.write(np.zeros((2160, 3840, 3), np.uint8))
    writer.release()
    sequence = open_dataset("video", path=path, intrinsics=[3000, 3000, 1919.5, 1079.5])
    item = next(iter(sequence))
    height, width = item.image.shape[:2]
    assert 1.3e6 < height * width <= 1.55e6
    np.testing.assert_allclose(item.intrinsics[:2], [3000 * width / 3840, 3000 * height / 2160])
    assert [w for w in sequence.warnings if "3840x2160" in w and "dataset.size=" in w]
    asked = open_dataset("video", path=path, intrinsics=[3000, 3000, 1919.5, 1079.5], size=3840 * 2160)
    assert next(iter(asked)).image.shape == (2160, 3840, 3)
    assert not [w for w in asked.warnings if "3840x2160" in w]
