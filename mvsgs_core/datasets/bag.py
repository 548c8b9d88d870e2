"""ROS 1 and ROS 2 bags, read without ROS by `rosbags` (optional: pip install rosbags)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.datasets import Item, dataset
from mvsgs_core.datasets.bag_file import is_bag_folder, messages, opened_bag
from mvsgs_core.datasets.bag_lens import INFO, LensInTime, first_lens, info_topics
from mvsgs_core.datasets.bag_poses import poses_in
from mvsgs_core.datasets.calibration import lens_from_option
from mvsgs_core.datasets.cut_off_bag import CutOffBag
from mvsgs_core.datasets.files import Layout
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.ros import rectified, rgb_of, seconds_of
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
_Picture = tuple[float, float, np.ndarray, Lens]  # seconds by the bag's clock and by the camera's, and RGB
_NOT_COLOR = ("depth", "infra", "disparity", "mask")


@dataset
@dataclass(kw_only=True, eq=False)
class Bag(FileReader):
    """Images of one topic, undistorted, with the time stamps of their headers; where these stand still, go back or
    leap, as a clock that is set makes them, time goes on by the bag's own. A first one that is hours off is replaced.

    intrinsics (or "auto") and distortion replace its calibration; where there is none, or an empty one, the lens is the
    guess of "auto", for the tracker to estimate. Where the calibration changes, each image has that of its time.
    Damaged messages are left out and counted. Raises ImportError without rosbags, FileNotFoundError and ValueError,
    which say what was expected, BadFileError for a bag that cannot be read or holds no image that can be.
    """

    topic: str | None = None  # of the images; null: the only color one
    info_topic: str | None = None  # of their calibration; null: camera_info beside the images
    # odom, map: poses are those of the camera in this frame of the bag's /tf, by its own odometry; null: there are none
    fixed_frame: str | None = None
    camera_frame: str | None = None  # the camera's in /tf, x right, y down, z forward; null: as its images name it

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
            (native, frame), lens = _first_image(bag, self._topic), None
            if self.intrinsics is None:
                infos = info_topics(bag, self._topic, self.info_topic, self._notices)
                lens = first_lens(bag, infos, rectified(self._topic), self._notices)
            camera = frame if self.camera_frame is None else self.camera_frame
            self._poses = None if self.fixed_frame is None else poses_in(bag, camera, self.fixed_frame, self._notices)
            self._info_topic = None if lens is None else infos[0].topic
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
        """Of the image as it is in the file, where its calibration does not change later."""
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
                received, seconds, image, lens = picture
                repaired = times.repaired
                shown = times.accept(seconds)
                if shown is None:
                    what = "images left out because their time stamps are from before, or hours after, those before"
                    self._notices.tally(what, f"{seconds:.3f} s")
                    continue
                if times.repaired > repaired:
                    what = "places where time stamps stood still, went back or leapt: there the bag's times were taken"
                    self._notices.tally(what, f"at the stamp {seconds:.3f} s")
                yield self._item(index, shown, image, seconds, lens)
                index += 1
        self._end_places()
        if index == 0:
            raise BadFileError(f"no image of {self._topic} could be read: " + "; ".join(self.warnings))

    def _pictures(self, bag: OpenBag) -> Iterator[_Picture]:
        """Each once the next has come, as the calibration at its stamp may come after it."""
        wanted = range(self._count)[self.wanted]
        infos = [c for c in bag.connections if (c.topic, c.msgtype) == (self._info_topic, INFO)]
        topics = [*infos, *(c for c in bag.connections if c.topic == self._topic)]
        lenses = LensInTime(self._lens, rectified(self._topic), self._notices)
        number, last = -1, None
        for connection, nanoseconds, data in messages(bag, topics, self._notices):
            if connection.msgtype == INFO:
                lenses.add(bag, nanoseconds, data)
                continue
            number += 1
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
            if last is not None:
                yield *last, lenses.at(last[1])
            last = 1e-9 * nanoseconds, seconds, image
        if last is not None:
            yield *last, lenses.at(last[1])

    def _with_first_time(self, pictures: Iterator[_Picture]) -> Iterator[_Picture]:
        """The same, the first at the time that the next two agree on, by the bag's, where its own is hours off."""
        first = list(islice(pictures, 3))
        if len(first) == 3:
            ahead = [seconds - received for received, seconds, *_ in first]
            if abs(ahead[0] - ahead[1]) > LEAP > abs(ahead[1] - ahead[2]):
                received, seconds, image, lens = first[0]
                first[0] = received, received + ahead[1], image, lens
                self._notices.append(
                    f"the first time stamp, {seconds:.3f} s, is hours off those after it: it is taken to be "
                    f"{received + ahead[1]:.3f} s, by the bag's times"
                )
        return chain(first, pictures)

    def _item(self, index: int, seconds: float, image: np.ndarray, stamp: float, original: Lens) -> Item:
        """stamp: by the camera's clock, as GPS has it, which the time in the stream may be off from."""
        native = image.shape[0], image.shape[1]
        lens, size = original.at(native), self._framing.size_of(self._lens.size)
        framed, intrinsics = self._framing.image(image, lens, size)
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, lens, size)
        return Item(
            index,
            seconds,
            framed,
            intrinsics,
            intrinsics_guessed=lens.guessed,
            place=self._place(stamp),
            mask=mask,
            original=np.array(original.at(self._lens.size).intrinsics, np.float64),
            world_from_cam=None if self._poses is None else self._poses.at(stamp, self._notices),
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


def _first_image(bag: OpenBag, topic: str) -> tuple[tuple[int, int], str]:
    """Its height and width, and the name of its camera's frame of reference."""
    found = Notices()  # reading the sequence reports it, where one can be read
    for connection, _, data in messages(bag, [c for c in bag.connections if c.topic == topic], found):
        try:
            _, image = _picture(bag, connection, 0, data)
        except BadFileError as error:
            found.tally("images that could not be read", str(error))
            continue
        message: Any = bag.deserialize(data, connection.msgtype)
        return (image.shape[0], image.shape[1]), message.header.frame_id
    raise BadFileError(": ".join([f"no image of {topic} can be read", *found]))


def _picture(bag: OpenBag, connection: BagTopic, nanoseconds: int, data: bytes) -> tuple[float, np.ndarray]:
    """Seconds and (H, W, 3) uint8 RGB of a message. Raises BadFileError for a damaged one."""
    with reading("a message", "cannot be read"):
        message = bag.deserialize(data, connection.msgtype)
        return seconds_of(message, nanoseconds), rgb_of(message)
