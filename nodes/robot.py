"""Source: frames that another program, such as a robot's, publishes over ZeroMQ; msgs/WIRE.md has their form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from msgs import End, Frame
from msgs.codec import CodecError
from mvsgs_core.camera import resize_image, scale_intrinsics
from mvsgs_core.datasets.calibration import size_doubt
from mvsgs_core.datasets.framing import Framing, target_size
from mvsgs_core.datasets.lens import Lens
from mvsgs_core.export.source_camera import LENS, lens_values
from nodes.live import LiveSource, camera_mask
from nodes.runtime.addresses import TransportError, check_address, load_keys, unknown_host
from nodes.runtime.transport import LiveReader


class Robot(LiveSource):
    """Frames published elsewhere -> Frame, numbered anew, and GroundTruth with the same image to score renders against.

    Best effort: only the newest frame is taken, the robot is never held back. What it sends is not trusted: what is no
    usable frame is left out and counted; the stream ends with an End that is one, or with silence.
    """

    @dataclass
    class Config(LiveSource.Config):
        path: str = "tcp://127.0.0.1:5555"  # address at which the other program publishes Frame messages
        keys: str | None = None  # folder with the CURVE keys that the publisher has too; null: none

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._breaks = 0  # of the connection, that were said

    @classmethod
    def check(cls, config: Config) -> None:
        try:
            check_address(config.path)
            if config.keys is not None:
                load_keys(Path(config.keys))
            camera_mask(config.mask)
        except TransportError as error:
            raise ValueError(str(error)) from error

    def _open(self) -> None:
        """Raises TransportError for an address that is none and for keys that cannot be read."""
        keys = None if self.config.keys is None else load_keys(Path(self.config.keys))
        if (host := unknown_host(self.config.path)) is not None:
            self.stats.warn(f"nobody here knows a host {host}: is its name right, and is it in the network?")
        self._reader = LiveReader(self.config.path, Frame, topic=f"robot at {self.config.path}", keys=keys)

    def _close(self) -> None:
        self._reader.close()

    @property
    def _sender(self) -> str:
        return "the robot"

    @property
    def _silence(self) -> str:
        return f"no usable frame from {self.config.path}"

    def _hint(self) -> str:
        if self._reader.met:
            return (
                "a program answers there, but nothing that it sends is a message of this system: it must publish "
                "Frames as examples/robot.py does (msgs/WIRE.md has their form)"
            )
        return "is the program that publishes there running (see examples/robot.py)?"

    def _next(self, seconds: float) -> Frame | End | None:
        """Raises ConnectionError where the robot refuses the keys."""
        try:
            message = self._reader.receive(seconds)
        except TransportError as error:  # a user's matter, which no traceback explains
            raise ConnectionError(str(error)) from error
        except CodecError as error:
            self.stats.warn(f"the robot sent what is no Frame, it was left out: {error}")
            return None
        finally:
            self._watch(self._reader)
        if isinstance(message, Frame):
            self._presence.came()
        return message if isinstance(message, Frame | End) else None

    def _watch(self, reader: LiveReader) -> None:
        self.stats.counts["dropped"] = reader.skipped
        self.stats.counts["refused"] = reader.refused
        if reader.reconnected > self.stats.counts.get("reconnected", 0):
            self.stats.counts["reconnected"] = reader.reconnected
            self.stats.warn("the connection to the robot broke, as a frame too large makes it, and was made anew")
        if reader.breaks > self._breaks:
            self._breaks = reader.breaks
            self._presence.lost("its connection broke")
        if reader.renumbered > self.stats.counts.get("renumbered", 0):
            self.stats.counts["renumbered"] = reader.renumbered
            self.stats.warn("the robot's sequence numbers jumped, as they do when its program starts again")
            self._frames.restarted()

    def _framed(self, frame: Frame) -> Frame:
        native = self._frames.native
        assert native is not None
        size = target_size(self.config.size, native)
        if LENS not in self.stats.values:
            fx, fy, cx, cy = frame.intrinsics.tolist()
            lens = Lens((fx, fy, cx, cy), native, guessed=frame.intrinsics_guessed)
            self.stats.values[LENS] = lens_values(lens)
            for doubt in size_doubt(lens, "intrinsics="):
                self.stats.warn(f"the robot's frames: {doubt}")
            for note in Framing(self.config.size).notice(native):
                self.stats.warn(note)
        intrinsics = scale_intrinsics(frame.intrinsics, native, size)
        return replace(
            frame, image=resize_image(frame.image, size), intrinsics=intrinsics, mask=self._mask(frame, size)
        )

    def _mask(self, frame: Frame, size: tuple[int, int]) -> np.ndarray | None:
        """(h, w) bool: what the robot's own mask and that of all frames leave alike; None: every pixel counts."""
        native = frame.image.shape[0], frame.image.shape[1]
        fx, fy, cx, cy = frame.intrinsics.tolist()
        lens, framing = Lens((fx, fy, cx, cy), native), Framing(self.config.size)
        common = None if self._camera_mask is None else self._camera_mask.framed(framing, lens, size)
        own = None if frame.mask is None else framing.mask(frame.mask, lens, size)
        return common if own is None else own if common is None else own & common
