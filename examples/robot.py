"""A robot: publishes a camera, a video or a data set as frames that `dataset=robot` maps, from another process or host.

    python examples/robot.py --camera 0 --intrinsics 610 610 320 240
    python examples/robot.py --video walk.mp4
    python examples/robot.py --dataset tum rgbd_dataset_freiburg1_xyz
    mvsgs dataset=robot dataset.path=tcp://127.0.0.1:5555

With --ros2 it stands for a camera of ROS 2, as far as dataset=ros2 is concerned (pip install cyclonedds):

    python examples/robot.py --video walk.mp4 --ros2 /camera/image_raw
    mvsgs dataset=ros2 dataset.path=/camera/image_raw

Otherwise this uses the project's own transport. A robot in another language writes the same bytes to a ZeroMQ XPUB or
PUB socket: msgs/WIRE.md has them. Beyond this machine (--address tcp://0.0.0.0:5555) keys are required, see --keys.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

try:
    import numpy as np

    from msgs import Frame, GroundTruth
    from mvsgs_core.datasets import Sequence, check, open_dataset
    from mvsgs_core.datasets.ros import camera_info_topic
    from nodes.camera import Camera
    from nodes.ros2 import forms
    from nodes.ros2.connection import DEFAULT, LOOPBACK, Connection, DdsError, check_installed
    from nodes.ros2.messages import CameraInfo, Image
    from nodes.runtime.addresses import TransportError, load_keys
    from nodes.runtime.transport import LivePublisher
except ModuleNotFoundError as error:
    sys.exit(f"error: {error}: run `make setup` once, then .venv/bin/python examples/robot.py")

GUESSED = "the intrinsics are a guess, and the frames say so: the tracker estimates the focal length (--intrinsics)"


def opened(arguments: argparse.Namespace) -> Iterator[Frame]:
    """Frames of whatever the command line names. Raises ValueError or OSError at once where it cannot be read."""
    intrinsics = arguments.intrinsics or "auto"
    if arguments.camera is not None:
        config = Camera.Config(path=arguments.camera, intrinsics=intrinsics)
        Camera.check(config)
        return (message for message in Camera(config).run() if not isinstance(message, GroundTruth))
    if arguments.video is not None:
        name, options = "video", {"path": arguments.video, "intrinsics": intrinsics}
    else:
        name, options = arguments.dataset[0], {"path": arguments.dataset[1]}
        options |= {"intrinsics": arguments.intrinsics} if arguments.intrinsics else {}
    check(name, **options)
    return frames(open_dataset(name, **options), arguments.fast)


def frames(sequence: Sequence, fast: bool) -> Iterator[Frame]:
    """At the rate at which they were taken, or as fast as they can be read."""
    began: float | None = None
    for item in sequence:
        now = time.monotonic()
        began = now - item.timestamp if began is None else began
        if not fast:
            time.sleep(max(0.0, began + item.timestamp - now))
        guessed, exposure = item.intrinsics_guessed, item.exposure
        yield Frame(
            item.index, item.timestamp, item.image, item.intrinsics, guessed, exposure, place=item.place,
            mask=item.mask, world_from_cam=item.world_from_cam,
        )  # fmt: skip
    for warning in sequence.warnings:
        say(f"warning: {warning}")


class Ros2Camera:
    """Images with their CameraInfo, in $ROS_DOMAIN_ID, on this machine alone unless `interface` says more."""

    def __init__(self, topic: str, interface: str) -> None:
        from nodes.ros2.dds import Participant

        connection = Connection(interface=interface)
        participant = Participant(connection)
        self.topic = connection.topic(topic)
        self._images = participant.writer(self.topic, Image, DEFAULT)
        self._infos = participant.writer(camera_info_topic(self.topic), CameraInfo, DEFAULT)

    def wait_for_reader(self) -> None:
        while not (self._images.readers and self._infos.readers):
            time.sleep(0.1)

    def send(self, frame: Frame) -> None:
        at = forms.header(frame.timestamp, "camera_optical_frame")
        k = np.zeros(4) if frame.intrinsics_guessed else frame.intrinsics  # zeros: nobody calibrated it
        self._infos.write(forms.camera_info(at, k, frame.image.shape[:2]))
        self._images.write(forms.rgb_image(at, frame.image))

    def close(self) -> None:
        del self._images, self._infos  # reliable readers get what they still lack


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def wait_for_reader(publisher: LivePublisher, keys: Path | None) -> None:
    """Says at once if somebody comes who is turned away: from there it looks as if nobody published."""
    refused = f"its keys are not those in {keys}" if keys else "it has keys: give the same ones with --keys"
    told = False
    while not publisher.ready(1):
        if publisher.refused and not told:
            told = True
            say(f"warning: a reader was turned away: {refused}")
        time.sleep(0.1)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Publishes frames over ZeroMQ for dataset=robot.")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--camera", help="device number or URL")
    source.add_argument("--video", help="video file")
    source.add_argument("--dataset", nargs=2, metavar=("NAME", "PATH"), help="data set, such as tum DIR")
    parser.add_argument("--intrinsics", nargs=4, type=float, metavar=("FX", "FY", "CX", "CY"), help="in pixels")
    parser.add_argument("--address", default="tcp://127.0.0.1:5555", help="where to publish (default: %(default)s)")
    parser.add_argument("--ros2", metavar="TOPIC", help="publish to ROS 2 instead, with CameraInfo beside the images")
    parser.add_argument(
        "--interface", default=LOOPBACK, help="with --ros2: auto for the network (default: %(default)s)"
    )
    parser.add_argument("--keys", type=Path, help="folder with CURVE keys, needed beyond this machine")
    parser.add_argument("--fast", action="store_true", help="as fast as frames can be read, not at their own rate")
    return parser.parse_args(arguments)


def main() -> None:
    arguments = parse()
    publisher: LivePublisher | Ros2Camera
    try:
        keys = None if arguments.keys is None else load_keys(arguments.keys)
        if arguments.ros2 is not None:
            check_installed()
        images = opened(arguments)
        publisher = (
            LivePublisher(arguments.address, keys=keys)
            if arguments.ros2 is None
            else Ros2Camera(arguments.ros2, arguments.interface)
        )
    except (TransportError, DdsError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `kill` and systemd end it as Ctrl-C does
    sent = 0
    try:
        print(f"publishing at {arguments.ros2 or arguments.address}, waiting for a reader; Ctrl-C ends", flush=True)
        if isinstance(publisher, Ros2Camera):
            publisher.wait_for_reader()
        else:
            wait_for_reader(publisher, arguments.keys)
        for frame in images:
            if frame.intrinsics_guessed and not sent:
                say(f"warning: {GUESSED}")
            publisher.send(frame)
            sent += 1
    except KeyboardInterrupt:
        pass
    except (DdsError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    finally:
        publisher.close()  # tells the readers that this is the end
        print(f"{sent} frames sent")


if __name__ == "__main__":
    main()
