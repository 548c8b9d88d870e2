"""ROS 1 and ROS 2 bags."""

from __future__ import annotations

import io
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mvsgs_core.bad_file import BadFileError
from mvsgs_core.datasets import open_dataset, recognized
from mvsgs_core.datasets.bag_file import opened_bag
from mvsgs_core.datasets.files import UnreadableImageError
from mvsgs_core.datasets.mcap_file import ROS_2, profile_of
from mvsgs_core.datasets.ros import rgb_of
from mvsgs_core.stream_times import StreamTimes
from tests.support.dataset_folders import huge_png

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from tests.support.bag_messages import HEIGHT, WIDTH, Messages, images_of, picture, walk, write_walk


@pytest.fixture(params=[1, 2])
def ros(request: pytest.FixtureRequest) -> Messages:
    return Messages(request.param)


def bag_path(folder: Path, ros: Messages) -> Path:
    return folder / ("walk.bag" if ros.ros == 1 else "walk")


def png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "png")
    return buffer.getvalue()


def test_raw_images_with_their_calibration(tmp_path: Path, ros: Messages) -> None:
    messages: list[tuple[str, float, Any]] = [("/camera/color/camera_info", 1.0, ros.info())]
    for i in range(6):
        bgr = np.ascontiguousarray(picture(i)[..., ::-1])
        messages.append(("/camera/color/image_raw", 1.0 + i, ros.image(i, "bgr8", bgr, 3 * WIDTH)))
        deep = np.zeros((HEIGHT, WIDTH, 2), dtype=np.uint8)
        messages.append(("/camera/depth/image_raw", 1.0 + i, ros.image(i, "16UC1", deep, 2 * WIDTH)))
    path = ros.write(bag_path(tmp_path, ros), messages)
    sequence = open_dataset("bag", path=path, start=1, stop=6, stride=2)
    items = list(sequence)
    assert len(sequence) == len(items) == 3
    assert sequence.warnings == []
    for item, number in zip(items, (1, 3, 5)):
        assert item.timestamp == pytest.approx(100 + number / 10)
        assert item.image[10, 10].tolist() == [20 + number, 100, 200]
        assert item.intrinsics[0] > 40  # zoomed in, to hide what undistortion leaves empty
        assert item.intrinsics[0] / item.intrinsics[1] == pytest.approx(40 / 41)
        np.testing.assert_allclose(item.intrinsics[2:], [15.5, 11.5])
    given = next(iter(open_dataset("bag", path=path, intrinsics=[44, 45, 16, 12])))
    np.testing.assert_allclose(given.intrinsics, [44, 45, 16, 12])
    with pytest.raises(ValueError, match=r"dataset\.distortion is not used"):
        open_dataset("bag", path=path, distortion=[0.3, 0, 0, 0])
    with pytest.raises(ValueError, match="no images at /else; it has them at: /camera/color/image_raw, /camera/depth"):
        open_dataset("bag", path=path, topic="/else")
    with pytest.raises(ValueError, match="no frame left"):
        open_dataset("bag", path=path, start=6)


@pytest.mark.parametrize("step", [-50.0, 1.7e9])
def test_a_camera_whose_clock_was_set_goes_on_by_the_bags_times(tmp_path: Path, ros: Messages, step: float) -> None:
    messages = []
    for i in range(20):
        image = ros.image(i, "rgb8", picture(i), 3 * WIDTH)
        image.header.stamp.sec += int(step) if i >= 10 else 0
        messages.append(("/camera/image_raw", 1000 + i / 10, image))
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), messages))
    for _ in range(2):
        items = list(sequence)
        numbers = [int(item.image[0, 0, 0]) - 20 for item in items]
        assert numbers == [*range(10), *range(14, 20)]  # as many are needed to tell a clock from a late image
        np.testing.assert_allclose([item.timestamp for item in items], [100 + i / 10 for i in numbers], atol=1e-6)
        assert any("time stamps stood still, went back or leapt" in warning for warning in sequence.warnings)
        assert any("those before: 4" in warning for warning in sequence.warnings)


def test_stamps_that_stand_still_are_replaced_and_a_late_image_is_left_out(tmp_path: Path, ros: Messages) -> None:
    still = [("/camera/image_raw", 7 + i / 10, ros.image(0, "rgb8", picture(i), 3 * WIDTH)) for i in range(4)]
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), still))
    np.testing.assert_allclose([item.timestamp for item in sequence], [100.0, 100.1, 100.2, 100.3], atol=1e-6)
    (tmp_path / "late").mkdir()
    order = [0, 1, 3, 2, 4]
    late = [("/camera/image_raw", 7 + i / 10, ros.image(n, "rgb8", picture(n), 3 * WIDTH)) for i, n in enumerate(order)]
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path / "late", ros), late))
    assert [round(item.timestamp, 6) for item in sequence] == [100.0, 100.1, 100.3, 100.4]


@pytest.mark.parametrize("late", [0.0, 0.04])
def test_a_stamp_that_was_given_twice_shifts_no_time_after_it(tmp_path: Path, ros: Messages, late: float) -> None:
    """late: seconds by which the bag got every tenth image later than the others."""
    messages = []
    for i in range(60):
        image = ros.image(i - (i % 10 == 9), "rgb8", picture(i), 3 * WIDTH)
        messages.append(("/camera/image_raw", 7 + i / 10 + late * (i % 10 == 9), image))
    items = list(open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), messages)))
    assert len(items) == 60
    np.testing.assert_allclose([item.timestamp for item in items], 100 + np.arange(60) / 10, atol=late + 1e-6)
    np.testing.assert_allclose(items[58].timestamp, 105.8, atol=1e-6)


def test_stamps_in_pairs_of_images_that_come_unevenly_cost_no_image() -> None:
    """A camera of 15 images a second that is read 30 times: an image that came late is shown when it came, and the next
    ones are from before that by their stamps."""
    now = [0.0]
    times, late = StreamTimes(lambda: now[0]), np.random.default_rng(0).exponential(0.03, 1800)
    came = np.maximum.accumulate(np.arange(1800) / 30 + late)
    shown = []
    for i, at in enumerate(came):
        now[0] = at
        shown.append(times.accept(100 + (i // 2) / 15))
    assert None not in shown
    assert (np.diff(np.array(shown)) > 0).all()
    assert abs(shown[-1] - shown[0] - 60) < 5


def test_a_first_stamp_that_is_hours_off_is_replaced(tmp_path: Path, ros: Messages) -> None:
    messages = [("/camera/image_raw", 7 + i / 10, ros.image(i, "rgb8", picture(i), 3 * WIDTH)) for i in range(9)]
    messages[0][2].header.stamp.sec += 1_700_000_000
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), messages))
    for _ in range(2):
        np.testing.assert_allclose([item.timestamp for item in sequence], 100 + np.arange(9) / 10, atol=1e-6)
        told = [
            warning for warning in sequence.warnings if "the first time stamp, 1700000100.000 s, is hours" in warning
        ]
        assert len(told) == 1


def test_compressed_and_rectified_images(tmp_path: Path, ros: Messages) -> None:
    topic = "/front/image_rect_color/compressed"
    contents = [png(picture(0)), png(picture(1))[:-40], png(picture(2))]
    messages = [(topic, 1.0 + i, ros.compressed(i, data)) for i, data in enumerate(contents)]
    path = ros.write(bag_path(tmp_path, ros), [("/front/camera_info", 1.0, ros.info()), *messages])
    sequence = open_dataset("bag", path=path)
    for _ in range(2):
        items = list(sequence)
        assert [(item.index, item.image[0, 0, 0]) for item in items] == [(0, 20), (1, 22)]
        assert len(sequence.warnings) == 1
        assert sequence.warnings[0].startswith("images left out because they could not be read: 1")
    np.testing.assert_allclose(items[0].intrinsics, [50, 51, 16.5, 12.5])  # the projection matrix, no distortion


def test_images_of_a_part_of_the_sensor_and_smaller_ones_stay_of_their_size(tmp_path: Path, ros: Messages) -> None:
    part, smaller, topic = ros.info(), ros.info(), "/front/image_rect"
    part.height, part.width = smaller.height, smaller.width = 2 * HEIGHT, 2 * WIDTH
    part.roi.height, part.roi.width, part.roi.x_offset, part.roi.y_offset = HEIGHT, WIDTH, 4, 2
    frame = ros.image(0, "rgb8", picture(0), 3 * WIDTH)
    for info, intrinsics in ((part, [50, 51, 12.5, 10.5]), (smaller, [25, 25.5, 8, 6])):
        path = ros.write(bag_path(tmp_path, ros), [("/front/camera_info", 1.0, info), (topic, 1.0, frame)])
        sequence = open_dataset("bag", path=path)
        assert sequence.lens.size == (HEIGHT, WIDTH)
        item = next(iter(sequence))
        assert item.image.shape == (HEIGHT, WIDTH, 3)
        np.testing.assert_allclose(item.intrinsics, intrinsics)
        path.unlink() if path.is_file() else rmtree(path)


def test_what_is_missing_is_said(tmp_path: Path, ros: Messages) -> None:
    frame = ros.image(0, "rgb8", picture(0), 3 * WIDTH)
    path = ros.write(bag_path(tmp_path, ros), [("/left/image", 1.0, frame), ("/right/image", 1.0, frame)])
    with pytest.raises(ValueError, match=r"several image topics.*/left/image, /right/image"):
        open_dataset("bag", path=path)
    with pytest.raises(ValueError, match=r"no camera_info at /left/camera_info; it has it at: no topic"):
        open_dataset("bag", path=path, topic="/left/image", info_topic="/left/camera_info")
    uncalibrated = open_dataset("bag", path=path, topic="/left/image")
    assert uncalibrated.warnings[0] == "no calibration: the bag has no camera_info for /left/image"
    assert next(iter(uncalibrated)).intrinsics_guessed
    sequence = open_dataset("bag", path=path, topic="/left/image", intrinsics="auto", size=[12, 16])
    assert next(iter(sequence)).image.shape == (12, 16, 3)
    assert "guess" in sequence.warnings[0]
    (tmp_path / "other.bag").write_bytes(b"no bag")
    with pytest.raises(BadFileError, match="is no bag"):
        open_dataset("bag", path=tmp_path / "other.bag")


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("mono8", np.full((HEIGHT, WIDTH), 9, np.uint8), (9, 9, 9)),
        ("mono16", np.full((HEIGHT, WIDTH), 9 * 256 + 5, "<u2").view(np.uint8), (9, 9, 9)),
        ("rgba8", np.full((HEIGHT, WIDTH, 4), (1, 2, 3, 4), np.uint8), (1, 2, 3)),
        ("bgra8", np.full((HEIGHT, WIDTH, 4), (1, 2, 3, 4), np.uint8), (3, 2, 1)),
        ("bayer_rggb8", np.tile(np.array([[200, 90], [90, 10]], np.uint8), (HEIGHT // 2, WIDTH // 2)), (200, 90, 10)),
        ("bayer_bggr8", np.tile(np.array([[10, 90], [90, 200]], np.uint8), (HEIGHT // 2, WIDTH // 2)), (200, 90, 10)),
        ("bayer_grbg8", np.tile(np.array([[90, 200], [10, 90]], np.uint8), (HEIGHT // 2, WIDTH // 2)), (200, 90, 10)),
        ("bayer_gbrg8", np.tile(np.array([[90, 10], [200, 90]], np.uint8), (HEIGHT // 2, WIDTH // 2)), (200, 90, 10)),
        ("8UC4", np.full((HEIGHT, WIDTH, 4), (1, 2, 3, 4), np.uint8), (3, 2, 1)),
        ("rgb16", np.full((HEIGHT, WIDTH, 3), (256, 515, 1023), "<u2").view(np.uint8), (1, 2, 3)),
        ("bgra16", np.full((HEIGHT, WIDTH, 4), (256, 515, 1023, 9), "<u2").view(np.uint8), (3, 2, 1)),
        (
            "bayer_grbg16",
            np.tile(np.array([[90, 200], [10, 90]], "<u2") << 8, (HEIGHT // 2, WIDTH // 2)).view(np.uint8),
            (200, 90, 10),
        ),
        ("yuv422", np.tile(np.array([128, 77], np.uint8), (HEIGHT, WIDTH)), None),
        ("yuv422_yuy2", np.tile(np.array([77, 128], np.uint8), (HEIGHT, WIDTH)), None),
    ],
)
def test_encodings(encoding: str, data: np.ndarray, expected: tuple[int, int, int] | None) -> None:
    step = data.size // HEIGHT
    image = rgb_of(Messages(2).image(0, encoding, data, step))
    assert image.shape == (HEIGHT, WIDTH, 3)
    inner = image[8:16, 8:16].reshape(-1, 3)
    assert (inner == inner[0]).all()
    if expected is None:  # gray in YUV
        assert np.ptp(inner[0].astype(int)) <= 1
        assert 60 < inner[0][0] < 90
    else:
        assert tuple(inner[0]) == expected
    padded = np.concatenate([data.reshape(HEIGHT, -1).view(np.uint8), np.full((HEIGHT, 5), 77, np.uint8)], axis=1)
    np.testing.assert_array_equal(rgb_of(Messages(2).image(0, encoding, padded, step + 5)), image)


@pytest.mark.parametrize(("encoding", "size"), [("rgb8", 100), ("32FC1", HEIGHT * WIDTH * 4)])
def test_damaged_or_unknown_images_are_refused(encoding: str, size: int) -> None:
    with pytest.raises(UnreadableImageError, match=r"no 32x24 image|no color or gray image"):
        rgb_of(Messages(2).image(0, encoding, np.zeros(size, np.uint8), 3 * WIDTH))


def test_of_images_that_cannot_be_read_it_is_said_why(tmp_path: Path, ros: Messages) -> None:
    counts = np.zeros(2 * HEIGHT * WIDTH, np.uint8)
    deep = [("/c/image_raw", 1.0 + i, ros.image(i, "16UC1", counts, 2 * WIDTH)) for i in range(3)]
    with pytest.raises(BadFileError, match=r"no image of /c/image_raw can be read: .*: 3 \(first: .*'16UC1' is no col"):
        open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), deep))


def calibration(ros: Messages, seconds: float, focal: float, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Any:
    """Without distortion."""
    info = ros.info()
    info.header = ros.header(seconds)
    info.height, info.width = size
    (info.D if ros.ros == 1 else info.d)[:] = 0
    matrix = info.K if ros.ros == 1 else info.k
    matrix[0], matrix[4] = focal, focal and focal + 1
    return info


def test_each_image_has_the_calibration_of_its_time(tmp_path: Path, ros: Messages) -> None:
    """Which comes before it or after it."""
    messages = [("/c/image_raw", 1.0 + i, ros.image(i, "rgb8", picture(i), 3 * WIDTH)) for i in range(6)]
    for i, (focal, late) in enumerate(zip((40, 40, 44, 44.01, 48, 48), (-0.1, 0.1, 0.1, 0.1, -0.8, 0.1))):
        messages.append(("/c/camera_info", 1.0 + i + late, calibration(ros, 100 + i / 10, focal)))
    messages.append(("/c/camera_info", 2.5, calibration(ros, 100.15, 0)))  # says nothing
    messages.append(("/c/camera_info", 2.6, calibration(ros, 100.16, 30, (WIDTH, HEIGHT))))
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), sorted(messages, key=lambda m: m[1])))
    for _ in range(2):
        items = list(sequence)
        assert [item.intrinsics[0] for item in items] == pytest.approx([40, 40, 44, 44, 48, 48])
        assert [item.original[1] for item in items if item.original is not None] == pytest.approx(
            [41, 41, 45, 45, 49, 49]
        )
        assert sequence.warnings == [
            "calibrations left out because they are for another aspect ratio than the first: 1 (first: 24x32 for 32x24)"
        ]
    given = open_dataset("bag", path=bag_path(tmp_path, ros), intrinsics=[50, 50, 15.5, 11.5])
    assert {item.intrinsics[0] for item in given} == {50.0}


def test_the_first_calibration_that_says_anything_counts(tmp_path: Path, ros: Messages) -> None:
    messages = [("/c/camera_info", 1.0 + i, calibration(ros, 100 + i / 10, 44 if i > 2 else 0)) for i in range(6)]
    messages += [("/c/image_raw", 1.5 + i, ros.image(i, "rgb8", picture(i), 3 * WIDTH)) for i in range(6)]
    sequence = open_dataset("bag", path=ros.write(bag_path(tmp_path, ros), sorted(messages, key=lambda m: m[1])))
    assert [item.intrinsics[0] for item in sequence] == pytest.approx([44.0] * 6)
    assert sequence.warnings == []


def test_an_empty_calibration_is_a_guess(tmp_path: Path, ros: Messages) -> None:
    zeros = ros.info()
    (zeros.K if ros.ros == 1 else zeros.k)[:] = 0
    frame = ros.image(0, "rgb8", picture(0), 3 * WIDTH)
    path = ros.write(bag_path(tmp_path, ros), [("/camera/camera_info", 1.0, zeros), ("/camera/image_raw", 1.0, frame)])
    sequence = open_dataset("bag", path=path)
    assert "the camera was not calibrated" in sequence.warnings[0]
    assert next(iter(sequence)).intrinsics_guessed


def test_a_calibration_that_cannot_be_is_refused(tmp_path: Path, ros: Messages) -> None:
    info = ros.info()
    (info.K if ros.ros == 1 else info.k)[2] = 1e9
    frame = ros.image(0, "rgb8", picture(0), 3 * WIDTH)
    path = ros.write(bag_path(tmp_path, ros), [("/camera/camera_info", 1.0, info), ("/camera/image_raw", 1.0, frame)])
    with pytest.raises(BadFileError, match=r"/camera/camera_info in the bag .*principal point.*far outside"):
        open_dataset("bag", path=path)


def damage(path: Path, number: int) -> None:
    """Of a compressed bag of ROS 1 this chunk."""
    with opened_bag(path) as bag:
        chunk = list(bag.readers[0].chunks.values())[number]
    content = bytearray(path.read_bytes())
    content[chunk.datapos + 4 : chunk.datapos + 40] = bytes(36)
    path.write_bytes(content)


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_behind_a_damaged_chunk_of_ros_1_the_rest_is_read(tmp_path: Path, compression: str) -> None:
    ros = Messages(1)
    path = tmp_path / "walk.bag"
    writer = Writer1(path)
    writer.set_compression(getattr(Writer1.CompressionFormat, compression.upper()))
    writer.chunk_threshold = 1  # a chunk a message
    with writer:
        write_walk(ros, writer)
    damage(path, 3)
    sequence = open_dataset("bag", path=path)
    assert [item.image[0, 0, 0] for item in sequence] == [20, 21, 23, 24, 25]
    assert any("parts of the bag left out because they are damaged: 1 (first: damaged" in w for w in sequence.warnings)


@pytest.mark.parametrize("others", [True, False])
def test_damage_before_the_first_calibration_is_counted_once(tmp_path: Path, others: bool) -> None:
    ros, path = Messages(1), tmp_path / "walk.bag"
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.LZ4)
    writer.chunk_threshold = 1  # a chunk a message
    with writer:
        infos = [("/c/camera_info", 1.0 + i, ros.info()) for i in range(2 if others else 1)]
        ros.write_into(writer, [*infos, *images_of(ros)])
    damage(path, 0)
    sequence = open_dataset("bag", path=path)
    assert len(list(sequence)) == 6
    (told,) = [w for w in sequence.warnings if "damaged" in w]
    assert "parts of the bag left out because they are damaged: 1 (first: damaged" in told
    assert ("no calibration: /c/camera_info in the bag could not be read: " in told) != others
    assert sequence.lens.guessed != others


@pytest.mark.parametrize("mode", ["MESSAGE", "STORAGE"])
def test_compressed_bags_are_bounded(tmp_path: Path, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ros = Messages(2)
    path = tmp_path / "packed"
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if mode == "STORAGE" else StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        kind = "sensor_msgs/msg/Image"
        connection = writer.add_connection("/c/image_raw", kind, typestore=ros.store)
        for i in range(3):
            data = ros.store.serialize_cdr(ros.image(i, "rgb8", picture(i), 3 * WIDTH), kind)
            writer.write(connection, 10**9 * (i + 1), data)
    assert [item.image[0, 0, 0] for item in open_dataset("bag", path=path, intrinsics="auto")] == [20, 21, 22]
    monkeypatch.setattr("mvsgs_core.datasets.bag_file.MAX_BYTES", 1000)
    with pytest.raises(BadFileError, match="no image of /c/image_raw can be read"):
        open_dataset("bag", path=path, intrinsics="auto")


def test_images_in_messages_are_bounded_as_files_are(tmp_path: Path) -> None:
    huge_png(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match=r"30000x30000|exceeds limit"):
        rgb_of(Messages(2).compressed(0, (tmp_path / "a.png").read_bytes()))
    wide = Messages(2).image(0, "mono8", np.zeros(10, np.uint8), 2**32 - 1)
    wide.height, wide.width = 1, 10
    assert rgb_of(wide).shape == (1, 10, 3), "the last row's padding may be missing, and is not made up"


def test_metadata_that_would_take_its_parser_minutes(tmp_path: Path) -> None:
    path = walk(Messages(2), tmp_path / "walk")
    (path / "metadata.yaml").write_text("a: " + 10_000 * "[")
    with pytest.raises(BadFileError, match="nested deeper"):
        open_dataset("bag", path=path)


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_file_of_a_bag_by_itself(tmp_path: Path, plugin: StoragePlugin) -> None:
    ros = Messages(2)
    kind = "sensor_msgs/msg/Image"
    with Writer2(tmp_path / "walk", version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/c/image_raw", kind, typestore=ros.store)
        writer.write(connection, 1, ros.store.serialize_cdr(ros.image(0, "rgb8", picture(0), 3 * WIDTH), kind))
    (tmp_path / "walk/metadata.yaml").unlink()
    (path,) = (tmp_path / "walk").iterdir()
    assert recognized(path) == ["bag"] or profile_of(path) == ROS_2
    assert [item.image[0, 0, 0] for item in open_dataset("bag", path=path)] == [20]
