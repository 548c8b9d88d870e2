"""ROS 1 and ROS 2 bags, read without ROS by `rosbags` (optional: pip install rosbags)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import Item, dataset
from mvsgs_core.datasets.bag_file import is_bag_folder, messages, opened_bag
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.cut_off_bag import CutOffBag
from mvsgs_core.datasets.files import Layout
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.ros import calibrated, lens_of, rectified, rgb_of
from mvsgs_core.datasets.sequence import FileReader, Notices
from mvsgs_core.stream_times import LEAP, StreamTimes

if TYPE_CHECKING:
    from mvsgs_core.datasets.bag_file import BagTopic, OpenBag

LAYOUT = Layout(
    "A bag",
    "a ROS 1 file (.bag), a ROS 2 folder (metadata.yaml with .db3 or .mcap) or one .db3 or .mcap by itself, with an "
    "image topic and its camera_info; also one that was cut off",
    "your own robot (ros2 bag record /camera/image_raw /camera/camera_info), or the bags of TUM RGB-D and many others",
)
# That only bags have, .bag.active while one of ROS 1 is recorded; an .mcap file is one by its content, see mcap_file.
_SUFFIXES = (".bag", ".active", ".db3")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_Picture = tuple[float, float, np.ndarray]  # seconds by the bag's clock and by the camera's, and RGB
_INFO = "sensor_msgs/msg/CameraInfo"
_NOT_COLOR = ("depth", "infra", "disparity", "mask")


@dataset
@dataclass(kw_only=True, eq=False)
class Bag(FileReader):
    """Images of one topic, undistorted, with the time stamps of their headers; where these stand still, go back or
    leap, as a clock that is set makes them, time goes on by the bag's own. A first one that is hours off is replaced.

    intrinsics (or "auto") and distortion replace its calibration; where there is none, or an empty one, the lens is the
    guess of "auto", for the tracker to estimate.
    Damaged messages are left out and counted. Raises ImportError without rosbags, FileNotFoundError and ValueError,
    which say what was expected, BadFileError for a bag that cannot be read or holds no image that can be.
    """

    topic: str | None = None  # of the images; null: the only color one
    info_topic: str | None = None  # of their calibration; null: camera_info beside the images

    @staticmethod
    def recognizes(path: Path) -> bool:
        return path.suffix.lower() in _SUFFIXES if path.is_file() else is_bag_folder(path)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._path = LAYOUT.present(self.path)
        with opened_bag(self._path) as bag:
            self._walked = bag.connections if isinstance(bag, CutOffBag) else []
            self._notices += bag.warnings if isinstance(bag, CutOffBag) else []
            self._topic = _image_topic(bag, self.topic)
            self._count = sum(c.msgcount for c in bag.connections if c.topic == self._topic)
            lens, native = None, _first_size(bag, self._topic)
            if self.intrinsics is None:
                lens = _recorded_lens(bag, self._topic, self.info_topic, self._notices)
            if lens is None:
                given = "auto" if self.intrinsics is None else self.intrinsics
                lens, notes = lens_from_option(given, self.distortion, native)
                self.warnings += notes
            self._check_distortion(lens)
            self._lens = lens.at(native) if same_shape(native, lens.size) else lens  # of another shape: one left out
        self._open_mask(self._lens.size)
        self.warnings += self._framing.notice(self._lens.size)
        if self.start >= self._count:
            raise ValueError(f"no frame left: {self._topic} has {self._count}, wanted from {self.start}")
        self._opening_warnings = len(self.warnings)

    @property
    def lens(self) -> Lens:
        """Of the image as it is in the file."""
        return self._lens

    def __len__(self) -> int:
        """Frames selected; those that turn out unreadable are not delivered."""
        return len(range(self._count)[self.wanted])

    def __iter__(self) -> Iterator[Item]:
        self._notices.truncate(self._opening_warnings)
        index, received = 0, 0.0
        times = StreamTimes(lambda: received)
        with opened_bag(self._path, self._walked) as bag:
            for picture in self._with_first_time(self._pictures(bag)):
                received, seconds, image = picture
                repaired = times.repaired
                shown = times.accept(seconds)
                if shown is None:
                    what = "images left out because their time stamps are from before, or hours after, those before"
                    self._notices.tally(what, f"{seconds:.3f} s")
                    continue
                if times.repaired > repaired:
                    what = "places where time stamps stood still, went back or leapt: there the bag's times were taken"
                    self._notices.tally(what, f"at the stamp {seconds:.3f} s")
                yield self._item(index, shown, image, seconds)
                index += 1
        self._end_places()
        if index == 0:
            raise BadFileError(f"no image of {self._topic} could be read: " + "; ".join(self.warnings))

    def _pictures(self, bag: OpenBag) -> Iterator[_Picture]:
        wanted = range(self._count)[self.wanted]
        connections = [c for c in bag.connections if c.topic == self._topic]
        for number, (connection, nanoseconds, data) in enumerate(messages(bag, connections, self._notices)):
            if number >= wanted.stop:
                break
            if number not in wanted:
                continue
            try:
                seconds, image = _picture(bag, connection, nanoseconds, data)
            except BadFileError as error:
                self._notices.tally("images left out because they could not be read", str(error))
                continue
            native = image.shape[0], image.shape[1]
            if not same_shape(native, self._lens.size):
                what = "images left out because their calibration is for another aspect ratio"
                self._notices.tally(what, f"{native} for {self._lens.size}")
                continue
            yield 1e-9 * nanoseconds, seconds, image

    def _with_first_time(self, pictures: Iterator[_Picture]) -> Iterator[_Picture]:
        """The same, the first at the time that the next two agree on, by the bag's, where its own is hours off."""
        first = list(islice(pictures, 3))
        if len(first) == 3:
            ahead = [seconds - received for received, seconds, _ in first]
            if abs(ahead[0] - ahead[1]) > LEAP > abs(ahead[1] - ahead[2]):
                received, seconds, image = first[0]
                first[0] = received, received + ahead[1], image
                self._notices.append(
                    f"the first time stamp, {seconds:.3f} s, is hours off those after it: it is taken to be "
                    f"{received + ahead[1]:.3f} s, by the bag's times"
                )
        return chain(first, pictures)

    def _item(self, index: int, seconds: float, image: np.ndarray, stamp: float) -> Item:
        """stamp: by the camera's clock, as GPS has it, which the time in the stream may be off from."""
        native = image.shape[0], image.shape[1]
        lens, size = self._lens.at(native), self._framing.size_of(self._lens.size)
        framed, intrinsics = self._framing.image(image, lens, size)
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, lens, size)
        place, guessed = self._place(stamp), self._lens.guessed
        original = np.array(self._lens.intrinsics, np.float64)
        return Item(
            index, seconds, framed, intrinsics, intrinsics_guessed=guessed, place=place, mask=mask, original=original
        )


def _image_topic(bag: OpenBag, given: str | None) -> str:
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


def _recorded_lens(bag: OpenBag, topic: str, given: str | None, notices: Notices) -> Lens | None:
    """The lens of the camera_info beside the images, or of the topic `given`; None, said in `notices`, without one."""
    topics = sorted({c.topic for c in bag.connections if c.msgtype == _INFO and c.msgcount})
    if given is not None and given not in topics:
        raise ValueError(f"the bag has no camera_info at {given}; it has it at: {', '.join(topics) or 'no topic'}")
    beside = [str(parent / "camera_info") for parent in PurePosixPath(topic).parents]
    chosen = next((t for t in ((given,) if given is not None else beside) if t in topics), None)
    if chosen is None:
        others = f", only at {', '.join(topics)} (dataset.options.info_topic chooses one)" if topics else ""
        notices.append(f"no calibration: the bag has no camera_info for {topic}{others}")
        return None
    for _, _, data in messages(bag, [c for c in bag.connections if c.topic == chosen], notices):
        with reading(chosen, "in the bag is no camera_info that can be used; set dataset.intrinsics=[fx,fy,cx,cy]"):
            info = bag.deserialize(data, _INFO)
            if calibrated(info):
                return lens_of(info, rectified(topic))
            break
    notices.append(f"no calibration: {chosen} in the bag is empty, the camera was not calibrated")
    return None


def _first_size(bag: OpenBag, topic: str) -> tuple[int, int]:
    ignored = Notices()  # reading the sequence reports it
    for connection, _, data in messages(bag, [c for c in bag.connections if c.topic == topic], ignored):
        try:
            _, image = _picture(bag, connection, 0, data)
        except BadFileError:
            continue
        return image.shape[0], image.shape[1]
    raise BadFileError(f"no image of {topic} can be read")


def _picture(bag: OpenBag, connection: BagTopic, nanoseconds: int, data: bytes) -> tuple[float, np.ndarray]:
    """Seconds and (H, W, 3) uint8 RGB of a message. Raises BadFileError for a damaged one."""
    with reading("a message", "cannot be read"):
        message = bag.deserialize(data, connection.msgtype)
        return _seconds(message, nanoseconds), rgb_of(message)


def _seconds(message: Any, nanoseconds: int) -> float:
    """The header's time stamp, the bag's own where the header has none."""
    stamp = message.header.stamp
    seconds = stamp.sec + 1e-9 * stamp.nanosec
    return float(seconds) if seconds > 0 else 1e-9 * nanoseconds
