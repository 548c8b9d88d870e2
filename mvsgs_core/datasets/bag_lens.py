"""What the CameraInfo of a bag says of its camera, from the first that says anything: autofocus and zoom change it."""

from __future__ import annotations

from itertools import islice
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from mvsgs_core.bad_file import BadFileError, reading
from mvsgs_core.camera import same_intrinsics
from mvsgs_core.datasets.bag_file import messages
from mvsgs_core.datasets.framing import same_shape
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.datasets.ros import calibrated, lens_of, seconds_of
from mvsgs_core.datasets.sequence import Notices

if TYPE_CHECKING:
    from mvsgs_core.datasets.bag_file import BagTopic, OpenBag

INFO = "sensor_msgs/msg/CameraInfo"
_TRIED = 1000  # messages of a topic, of which one must say something: drivers load their calibration within seconds


def info_topics(bag: OpenBag, topic: str, given: str | None, notices: Notices) -> list[BagTopic]:
    """The camera_info beside the images of `topic`, or that of the topic `given`; none, said in `notices`, without one.

    Raises ValueError where it is not where it was given.
    """
    topics = sorted({c.topic for c in bag.connections if c.msgtype == INFO and c.msgcount})
    if given is not None and given not in topics:
        raise ValueError(f"the bag has no camera_info at {given}; it has it at: {', '.join(topics) or 'no topic'}")
    beside = [str(parent / "camera_info") for parent in PurePosixPath(topic).parents]
    chosen = next((t for t in ((given,) if given is not None else beside) if t in topics), None)
    if chosen is None:
        others = f", only at {', '.join(topics)} (dataset.options.info_topic chooses one)" if topics else ""
        notices.append(f"no calibration: the bag has no camera_info for {topic}{others}")
    return [c for c in bag.connections if c.topic == chosen and c.msgtype == INFO]


def first_lens(bag: OpenBag, topics: list[BagTopic], rectified: bool, notices: Notices) -> Lens | None:
    """The lens of the first of these messages that says anything; None without topics, and, said in `notices`, where
    none does. Damage before it is not: reading the sequence reports it.

    rectified: ROS has undistorted the images already. Raises BadFileError for one that no camera has.
    """
    if not topics:
        return None
    topic, damage = topics[0].topic, Notices()
    for _, _, data in islice(messages(bag, topics, damage), _TRIED):
        with reading(topic, "in the bag is no camera_info that can be used; set dataset.intrinsics=[fx,fy,cx,cy]"):
            info = bag.deserialize(data, INFO)
            if calibrated(info):
                return lens_of(info, rectified)
    what = f"could not be read: {'; '.join(damage)}" if damage else "is empty, the camera was not calibrated"
    notices.append(f"no calibration: {topic} in the bag {what}")
    return None


class LensInTime:
    """The lens of a bag's camera by the stamps of its CameraInfo, each of which comes before its image or after."""

    def __init__(self, first: Lens, rectified: bool, notices: Notices) -> None:
        """first: until another one comes. rectified: ROS has undistorted the images already."""
        self._first, self._rectified, self._notices = first, rectified, notices
        self._changes = [(-np.inf, first)]  # seconds from which on a lens holds

    def add(self, bag: OpenBag, nanoseconds: int, data: bytes) -> None:
        """The next CameraInfo; one that says nothing, or cannot be of these images, changes nothing."""
        try:
            with reading("a camera_info", "cannot be used"):
                info = bag.deserialize(data, INFO)
                if not calibrated(info):
                    return
                seconds, lens = seconds_of(info, nanoseconds), lens_of(info, self._rectified)
        except BadFileError as error:
            self._notices.tally("calibrations left out because they cannot be used", str(error))
            return
        if not same_shape(lens.size, self._first.size):
            what = "calibrations left out because they are for another aspect ratio than the first"
            (height, width), (ours_high, ours_wide) = lens.size, self._first.size
            self._notices.tally(what, f"{width}x{height} for {ours_wide}x{ours_high}")
            return
        last = self._changes[-1][1]
        bends_alike = (lens.distortion, lens.fisheye) == (last.distortion, last.fisheye)
        if not (bends_alike and same_intrinsics(lens.at(last.size).intrinsics, last.intrinsics)):
            self._changes.append((seconds, lens))

    def at(self, seconds: float) -> Lens:
        """The one of an image with this stamp."""
        return next(lens for since, lens in reversed(self._changes) if since <= seconds)
