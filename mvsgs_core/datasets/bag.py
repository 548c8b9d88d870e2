"""ROS 1 and ROS 2 bags, read without ROS by `rosbags` (optional: pip install rosbags)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from mvsgs_core.datasets import Item
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.files import Layout, UnreadableImageError
from mvsgs_core.datasets.framing import Framing, Size
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.ros import lens_of, rgb_of
from mvsgs_core.datasets.sequence import Notices, same_shape, selection

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

LAYOUT = Layout(
    "A bag",
    "a ROS 1 file (.bag) or a ROS 2 folder (metadata.yaml with .db3 or .mcap) with an image topic and its camera_info",
    "your own robot (ros2 bag record /camera/image_raw /camera/camera_info), or the bags of TUM RGB-D and many others",
)
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO = "sensor_msgs/msg/CameraInfo"
_NOT_COLOR = ("depth", "infra", "disparity", "mask")


class Bag:
    """Images of one topic, undistorted, with the time stamps of their headers.

    topic: of the images; null takes the only color one. info_topic: of the calibration; null takes the camera_info
    beside the images. intrinsics (or "auto") and distortion replace it. size, crop: see `Framing`.
    Raises ImportError without rosbags, FileNotFoundError and ValueError, which say what was expected.
    """

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        size: Size = None,
        intrinsics: Sequence[float] | str | None = None,
        distortion: Sequence[float] = (),
        topic: str | None = None,
        info_topic: str | None = None,
        crop: int | None = None,
    ) -> None:
        if path is None or not str(path):
            raise LAYOUT.missing("no path was given (set dataset.path)")
        self._path = Path(path).expanduser()
        if not self._path.exists():
            raise LAYOUT.missing(f"{self._path} is missing")
        self._wanted = selection(start, stop, stride)
        self._framing = Framing(size, crop)
        self.warnings: list[str] = Notices()
        self._notices: Notices = self.warnings  # the same list, with its counting
        with self._open() as bag:
            self._topic = _image_topic(bag, topic)
            self._count = sum(c.msgcount for c in bag.connections if c.topic == self._topic)
            if intrinsics is None:
                self._lens = _recorded_lens(bag, self._topic, info_topic)
            else:
                self._lens, notes = lens_from_option(intrinsics, distortion, _first_size(bag, self._topic))
                self.warnings += notes
        if start >= self._count:
            raise ValueError(f"no frame left: {self._topic} has {self._count}, wanted from {start}")
        self._opening_warnings = len(self.warnings)

    def __len__(self) -> int:
        """Frames selected; those that turn out unreadable are not delivered."""
        return len(range(self._count)[self._wanted])

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)
        wanted = range(self._count)[self._wanted]
        index = 0
        with self._open() as bag:
            connections = [c for c in bag.connections if c.topic == self._topic]
            for number, (connection, nanoseconds, data) in enumerate(bag.messages(connections)):
                if number >= wanted.stop:
                    break
                if number not in wanted:
                    continue
                message = bag.deserialize(data, connection.msgtype)
                try:
                    image = rgb_of(message)
                except UnreadableImageError as error:
                    self._notices.tally("images left out because they could not be read", str(error))
                    continue
                native = image.shape[0], image.shape[1]
                if not same_shape(native, self._lens.size):
                    what = "images left out because their calibration is for another aspect ratio"
                    self._notices.tally(what, f"{native} for {self._lens.size}")
                    continue
                yield self._item(index, _seconds(message, nanoseconds), image)
                index += 1
        if index == 0:
            raise ValueError(f"no image of {self._topic} could be read: " + "; ".join(self.warnings))

    def _item(self, index: int, seconds: float, image: np.ndarray) -> Item:
        native = image.shape[0], image.shape[1]
        framed, intrinsics = self._framing.image(image, self._lens.at(native), self._framing.size_of(self._lens.size))
        return Item(index, seconds, framed, intrinsics, intrinsics_guessed=self._lens.guessed)

    @contextmanager
    def _open(self) -> Iterator[AnyReader]:
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ImportError("bags are read by rosbags, which is optional: pip install rosbags") from error
        try:
            # ROS 2 bags before Iron hold no message definitions; image and camera_info have not changed since
            bag = AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            bag.open()
        except AnyReaderError as error:
            raise LAYOUT.missing(f"{self._path} is no bag that can be read ({error})") from error
        try:
            yield bag
        finally:
            bag.close()


def _image_topic(bag: AnyReader, given: str | None) -> str:
    topics = sorted({c.topic for c in bag.connections if c.msgtype in _IMAGES and c.msgcount})
    if given is not None:
        if given not in topics:
            raise ValueError(f"the bag has no images at {given}; it has them at: {', '.join(topics) or 'no topic'}")
        return given
    color = [topic for topic in topics if not any(word in topic.lower() for word in _NOT_COLOR)]
    if len(color) == 1:
        return color[0]
    if not topics:
        raise ValueError("the bag has no sensor_msgs Image or CompressedImage")
    raise ValueError(f"the bag has several image topics; set dataset.options.topic to one of: {', '.join(topics)}")


def _recorded_lens(bag: AnyReader, topic: str, given: str | None) -> Lens:
    topics = sorted({c.topic for c in bag.connections if c.msgtype == _INFO and c.msgcount})
    beside = [str(parent / "camera_info") for parent in PurePosixPath(topic).parents]
    chosen = next((t for t in ((given,) if given is not None else beside) if t in topics), None)
    if chosen is None:
        raise ValueError(
            f"no camera_info for {given or topic}; set dataset.intrinsics=[fx,fy,cx,cy] or "
            f"dataset.options.info_topic to one of: {', '.join(topics) or 'none in this bag'}"
        )
    connections = [c for c in bag.connections if c.topic == chosen]
    _, _, data = next(bag.messages(connections))
    return lens_of(bag.deserialize(data, _INFO), rectified="rect" in PurePosixPath(topic).as_posix().split("image")[-1])


def _first_size(bag: AnyReader, topic: str) -> tuple[int, int]:
    for connection, _, data in bag.messages([c for c in bag.connections if c.topic == topic]):
        try:
            image = rgb_of(bag.deserialize(data, connection.msgtype))
        except UnreadableImageError:
            continue  # reading the sequence reports it
        return image.shape[0], image.shape[1]
    raise ValueError(f"no image of {topic} can be read")


def _seconds(message: Any, nanoseconds: int) -> float:
    """The header's time stamp, the bag's own where the header has none."""
    stamp = message.header.stamp
    seconds = stamp.sec + 1e-9 * stamp.nanosec
    return float(seconds) if seconds > 0 else 1e-9 * nanoseconds
