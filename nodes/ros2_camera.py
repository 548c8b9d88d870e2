"""Source: images that a program of ROS 2 publishes, with their calibration, over DDS and without ROS."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from msgs import Frame
from mvsgs_core.bad_file import BadFileError
from mvsgs_core.camera import same_intrinsics
from mvsgs_core.datasets.calibration import check_lens_option, lens_from_option
from mvsgs_core.datasets.framing import Framing, same_shape
from mvsgs_core.datasets.lens import Lens, Undistortion
from mvsgs_core.datasets.ros import COMPRESSED, calibrated, camera_info_topic, lens_of, rectified, rgb_of
from mvsgs_core.export.source_camera import LENS, lens_values
from nodes.live import LiveSource, camera_mask
from nodes.ros2.cdr import CdrError
from nodes.ros2.connection import LOOPBACK, SENSOR_DATA, Connection, check_installed
from nodes.ros2.messages import CameraInfo, CompressedImage, Image
from nodes.ros2_given_poses import GivenPoses

if TYPE_CHECKING:
    from nodes.ros2.dds import Reader

UNSTAMPED = 1.0  # s for which images without a time stamp are left out: a simulation may have no clock yet
POLL = 0.1  # s at most between two looks at the clock and at what was lost
POSED = 0.01  # s at most between two looks at /tf, while an image waits for its pose


class Ros2Camera(LiveSource):
    """sensor_msgs Image or CompressedImage -> Frame, undistorted, and GroundTruth with the same image.

    The newest image is taken, the sender is never held back. What comes is not trusted: what is no message, no image or
    no image of this stream is left out and counted. The stream ends with silence, as ROS 2 has no end.
    """

    @dataclass(kw_only=True)
    class Config(LiveSource.Config, Connection):
        path: str = "/camera/image_raw"  # topic of the images
        type: Literal["auto", "raw", "compressed"] = "auto"  # auto: compressed if the topic ends with /compressed
        info_topic: str | None = None  # of their CameraInfo; null: camera_info beside the images
        # [fx, fy, cx, cy] in pixels of the images; auto: a guess; null: CameraInfo's
        intrinsics: list[float] | str | None = None
        distortion: list[float] = field(default_factory=list)  # with intrinsics: [k1, k2, p1, p2(, k3)] as in OpenCV
        crop: int | None = None  # pixels cut off after undistortion; null: zoom to hide the empty border
        info_timeout: float = 5.0  # s from the first image without a CameraInfo before the focal length is guessed
        # lost images are sent again, for which the sender must be reliable too; null: once some were lost, if it is
        reliable: bool | None = None
        queue: int = SENSOR_DATA.depth  # images that may wait; of these the newest is taken
        # odom, map: frames come with the camera's pose in this frame of /tf, of the robot's own odometry; null: without
        fixed_frame: str | None = None
        camera_frame: str | None = None  # the camera's in /tf, x right, y down, z forward; null: as its images name it

        def __post_init__(self) -> None:
            LiveSource.Config.__post_init__(self)
            Connection.__post_init__(self)
            self.topic(self.path)
            if self.info_topic is not None:
                self.topic(self.info_topic)
            if self.queue < 1:
                raise ValueError(f"queue={self.queue}: at least one image must have a place")

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        c = self.config
        self._framing = Framing(c.size, c.crop)
        self._topic = c.topic(c.path)
        self._info_topic = c.topic(c.info_topic) if c.info_topic else camera_info_topic(self._topic)
        self._lens: Lens | None = None
        self._undone: Lens | None = None  # of the last CameraInfo whose distortion could be taken out
        self._warned_of_lens = False
        self._uncalibrated_since: float | None = None  # the first image without
        self._met = False  # somebody who publishes them
        self._camera_frame = ""  # as the last image named it
        # by time.monotonic, when images without a time stamp get the time here; None: none came, inf: others have one
        self._unstamped_until: float | None = None

    @classmethod
    def check(cls, config: Config) -> None:
        check_installed()
        camera_mask(config.mask)
        if config.intrinsics is not None:
            check_lens_option(config.intrinsics, config.distortion)

    def _open(self) -> None:
        """Raises DdsError."""
        from nodes.ros2.dds import Participant

        self._participant = Participant(self.config)
        self._read(reliable=bool(self.config.reliable))
        world = self.config.fixed_frame
        self._given = None if world is None else GivenPoses(self._participant, world, self.stats)

    def _read(self, reliable: bool) -> None:
        c = self.config
        compressed = self._topic.endswith(COMPRESSED) if c.type == "auto" else c.type == "compressed"
        quality = replace(SENSOR_DATA, reliable=reliable, depth=c.queue)
        self._images: Reader[Image] | Reader[CompressedImage]
        if compressed:
            self._images = self._participant.reader(self._topic, CompressedImage, quality)
        else:
            self._images = self._participant.reader(self._topic, Image, quality)
        self._infos = self._participant.reader(self._info_topic, CameraInfo, SENSOR_DATA)

    def _close(self) -> None:
        del self._images, self._infos, self._given, self._participant

    @property
    def _silence(self) -> str:
        return f"no usable image at {self._topic}"

    def _next(self, seconds: float) -> Frame | None:
        self._images.wait(min(POSED if self._given is not None and self._given.waits else POLL, seconds))
        waiting = self._images.take()
        self._met = self._met or self._images.writers > 0
        self._note_losses()
        if not waiting:
            if self._frames.native is not None and not self._images.writers:
                self._presence.lost("nobody publishes its images any more")
            return None if self._given is None else self._given.take()
        self._presence.came()
        self.stats.count("dropped", len(waiting) - 1)
        with self.stats.time("image"):
            frame = self._frame(waiting[-1])
        if self._given is None:
            return frame
        if frame is not None:
            self._given.add(frame, self.config.camera_frame or self._camera_frame)
        return self._given.take()

    def _note_losses(self) -> None:
        """Of datagrams: a best-effort image of which one is lost never comes, and nothing else tells of it."""
        lost = self._participant.overrun()
        if not lost.datagrams or self.config.reliable or not self._met:
            return
        if "datagrams_lost" not in self.stats.counts:
            self._ask_again(lost.room)
        self.stats.counts["datagrams_lost"] = lost.datagrams

    def _ask_again(self, room: int) -> None:
        """For lost images, if that is wanted and offered. room: bytes that the kernel keeps."""
        if not self._images.offered_reliable:
            what = "who publishes them sends none again"
        elif self.config.reliable is None:
            self._read(reliable=True)
            what = "from now on they are sent again"
        else:
            what = "dataset.reliable=true has them sent again"
        self.stats.warn(
            f"images are lost between processes: the kernel keeps {room // 1000} kB for what waits to be read; {what}. "
            "More room: sudo sysctl net.core.rmem_max=16777216"
        )

    def _hint(self) -> str:
        c = self.config
        if self._met:
            return "somebody publishes there, but sends nothing"
        hint = f"nobody publishes it in domain {c.number} on interface={c.interface}"
        if c.interface == LOOPBACK:
            return (
                f"{hint}: start its program here with ROS_LOCALHOST_ONLY=1, or look beyond with dataset.interface=auto"
            )
        return f"{hint} as {self._images.type.ros}: compare with ros2 topic info -v {self._topic}"

    def _frame(self, data: bytes) -> Frame | None:
        """What was sent, with its lens's intrinsics; None, counted and said, where there is no image in it."""
        try:
            message = self._images.decode(data)
            image = rgb_of(message)
        except CdrError as error:
            self.stats.refuse("messages", 1, f"what is no image message was left out: {error}")
            return None
        except BadFileError as error:
            self._frames.refuse(f"images left out because they could not be read: {error}")
            return None
        native = image.shape[0], image.shape[1]
        lens = self._lens_for(native)
        if lens is None:
            return None
        if not same_shape(native, lens.size):
            self._frames.refuse(
                f"images left out because their calibration is for another aspect ratio: {native} for {lens.size}"
            )
            return None
        stamp = self._stamp(message.header.stamp.nanoseconds)
        if stamp is None:
            return None
        self._camera_frame = message.header.frame_id
        intrinsics = np.array(lens.at(native).intrinsics)
        return Frame(0, stamp / 10**9, image, intrinsics, lens.guessed, stamp=stamp)

    def _stamp(self, nanoseconds: int) -> int | None:
        """Of an image, the time here where none comes with one; None where it is not known whether any will."""
        if nanoseconds > 0:
            self._unstamped_until = math.inf
            return nanoseconds
        if self._unstamped_until is None:
            self._unstamped_until = time.monotonic() + UNSTAMPED
        if time.monotonic() >= self._unstamped_until:
            return time.time_ns()
        self._frames.refuse(
            "images without a time stamp were left out, as a simulation sends them that has no clock yet"
        )
        return None

    def _lens_for(self, native: tuple[int, int]) -> Lens | None:
        """The lens of the stream, one for all of it; None as long as its CameraInfo is waited for."""
        if self._lens is not None:
            self._note_other_lens(native, self._lens)
        else:
            lens = self._given_lens(native) or self._calibrated_lens(native) or self._guessed_lens(native)
            self._lens = lens.at(native) if lens is not None and same_shape(native, lens.size) else lens
        if self._lens is None:
            self.stats.count("before_calibration")
        else:
            if LENS not in self.stats.values:
                for note in self._framing.notice(native):
                    self.stats.warn(note)
            self.stats.values[LENS] = lens_values(self._lens)
        return self._lens

    def _note_other_lens(self, native: tuple[int, int], ours: Lens) -> None:
        """Says where a CameraInfo comes that is not the one in use."""
        if self._warned_of_lens or self.config.intrinsics is not None:
            return
        lens = self._calibrated_lens(native)
        if lens is None:
            return
        theirs = lens.at(ours.size) if same_shape(ours.size, lens.size) else lens
        same_bend = (theirs.distortion, theirs.fisheye) == (ours.distortion, ours.fisheye)
        if same_bend and not ours.guessed and same_intrinsics(theirs.intrinsics, ours.intrinsics):
            return
        self._warned_of_lens = True
        if ours.guessed:
            self.stats.warn(
                f"a calibration came at {self._info_topic} after the focal length was guessed, and is not used: start "
                f"again, now that it is sent, or wait longer for it with dataset.info_timeout (s, "
                f"{self.config.info_timeout:g} now)"
            )
        else:
            self.stats.warn(
                f"the calibration at {self._info_topic} changed while the stream ran (fx {ours.intrinsics[0]:.1f}, now "
                f"{theirs.intrinsics[0]:.1f}), and the first one is used on: fix the camera's zoom and focus, or start "
                "again after each change"
            )

    def _given_lens(self, native: tuple[int, int], otherwise: str | None = None) -> Lens | None:
        intrinsics = otherwise if self.config.intrinsics is None else self.config.intrinsics
        if intrinsics is None:
            return None
        lens, notes = lens_from_option(intrinsics, self.config.distortion, native)
        for note in notes:
            self.stats.warn(note)
        return lens

    def _calibrated_lens(self, native: tuple[int, int]) -> Lens | None:
        """Of the first new CameraInfo that says anything, and whose distortion can be taken out."""
        for data in self._infos.take():
            try:
                info = self._infos.decode(data)
                if calibrated(info):
                    lens = lens_of(info, rectified(self._topic))
                    if lens != self._undone:  # which takes longer than an image
                        Undistortion(lens.at(native), fill=self.config.crop is None)
                    self._undone = lens
                    return lens
                self.stats.warn(f"the CameraInfo at {self._info_topic} is empty: the camera was not calibrated")
            except ValueError as error:  # what is no message (CdrError) and what no camera has
                self.stats.refuse("calibrations", 1, f"a CameraInfo that cannot be used was left out: {error}")
        return None

    def _guessed_lens(self, native: tuple[int, int]) -> Lens | None:
        now = time.monotonic()
        self._uncalibrated_since = self._uncalibrated_since or now
        if now - self._uncalibrated_since < self.config.info_timeout:
            return None
        self.stats.warn(f"no calibration came at {self._info_topic} in {self.config.info_timeout:g} s")
        return self._given_lens(native, "auto")

    def _framed(self, frame: Frame) -> Frame:
        assert self._lens is not None
        native = frame.image.shape[0], frame.image.shape[1]
        size = self._framing.size_of(native)
        lens = self._lens.at(native)
        image, intrinsics = self._framing.image(frame.image, lens, size)
        mask = None if self._camera_mask is None else self._camera_mask.framed(self._framing, lens, size)
        return replace(frame, image=image, intrinsics=intrinsics, mask=mask)
