"""A loop over a camera in a program of your own: poses as frames come, the map at the end.

    python examples/camera_loop.py --camera 0 --save runs/desk
    python examples/camera_loop.py --video walk.mp4 --save runs/walk mapper.iterations=10

Words at the end are settings as of the command line. `Mapping.add` takes as long as the map needs, so a thread of its
own takes the camera's frames, and the loop always maps the newest: what came meanwhile is left out, and counted. A
video is read at its own rate, as a camera would give it, or frame by frame with --every-frame. Ctrl-C leaves the camera
and the map is finished and saved; a second one ends the program at once.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

try:
    import cv2
    import numpy as np

    from mvsgs import Mapping
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}: run `make setup` once, then .venv/bin/python examples/camera_loop.py")


POLL = 0.2  # s between two looks at Ctrl-C while no frame comes


@contextmanager
def ctrl_c() -> Iterator[threading.Event]:
    """Set by Ctrl-C, to be looked at between two frames: an exception in the midst of `Mapping.add` would end the
    stream before its map is finished. The second one ends the program at once."""
    pressed = threading.Event()

    def press(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        pressed.set()

    before = signal.signal(signal.SIGINT, press)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


class NewestFrame:
    """The newest frame of an OpenCV capture, taken by a thread. Iterating ends where the camera does, or once `left` is
    set."""

    def __init__(self, capture: cv2.VideoCapture, rate: float | None, left: threading.Event | None = None) -> None:
        """rate: frames a second at which a file is read; None: as they come from a camera."""
        self.left_out = 0
        self._left = left or threading.Event()
        self._capture, self._period = capture, 1.0 / rate if rate else 0.0
        self._changed = threading.Condition()
        self._newest: tuple[np.ndarray, float] | None = None
        self._ended = False
        threading.Thread(target=self._take, daemon=True).start()

    def __iter__(self) -> Iterator[tuple[np.ndarray, float]]:
        """(H, W, 3) RGB and seconds."""
        while not self._left.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ended, POLL)
                found, self._newest, ended = self._newest, None, self._ended
            if found is not None:
                yield cv2.cvtColor(found[0], cv2.COLOR_BGR2RGB), found[1]
            elif ended:
                return

    def _take(self) -> None:
        began, number = time.monotonic(), 0
        while True:
            time.sleep(max(0.0, began + number * self._period - time.monotonic()))
            taken, image = self._capture.read()
            number += 1
            with self._changed:
                self._ended = not taken
                if taken:
                    self.left_out += self._newest is not None
                    self._newest = image, time.monotonic() - began
                self._changed.notify()
            if not taken:
                return


def every_frame(capture: cv2.VideoCapture, rate: float, left: threading.Event) -> Iterator[tuple[np.ndarray, float]]:
    """Of a file, to its end or until `left` is set: none is left out, however long the map takes."""
    number = 0
    while not left.is_set() and (found := capture.read())[0]:
        yield cv2.cvtColor(found[1], cv2.COLOR_BGR2RGB), number / rate
        number += 1


def parse(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Maps a camera, or a video as if it were one.")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--camera", type=int, help="device number")
    source.add_argument("--video", help="video file")
    parser.add_argument("--every-frame", action="store_true", help="of a video: leave none out")
    parser.add_argument("--intrinsics", nargs=4, type=float, metavar=("FX", "FY", "CX", "CY"), help="else estimated")
    parser.add_argument("--save", type=Path, required=True, help="folder for the map")
    parser.add_argument("settings", nargs="*", help="such as mapper.iterations=10")
    return parser.parse_args(words)


def main(words: list[str] | None = None) -> None:
    options = parse(words)
    capture = cv2.VideoCapture(options.video if options.camera is None else options.camera)
    if not capture.isOpened():
        sys.exit(f"error: {options.video or options.camera} cannot be opened")
    rate = None if options.camera is not None else capture.get(cv2.CAP_PROP_FPS) or 30.0
    phase = ""
    with ctrl_c() as left:
        newest = None if options.every_frame and rate else NewestFrame(capture, rate, left)
        frames = newest or every_frame(capture, rate or 30.0, left)
        with Mapping(*options.settings, intrinsics=options.intrinsics) as mapping:
            for image, seconds in frames:
                tracked = mapping.add(image, seconds)
                if tracked.phase != phase:
                    phase = tracked.phase
                    print(f"{seconds:7.2f} s  {phase}")
                for index in tracked.keyframes:
                    print(f"{seconds:7.2f} s  keyframe {index}")
            if left.is_set():
                print("the camera is left; the map is finished (Ctrl-C again: stop now)")
        print(f"{len(mapping.map)} splats; saved in {mapping.save(options.save)}")
    if newest is not None:
        print(f"{newest.left_out} frames were left out while the map was at work")
    for warning in mapping.warnings:
        print(f"warning: {warning}")


if __name__ == "__main__":
    main()
