"""Images that a program of ROS 2 publishes with their calibration, and what dataset=ros2 makes of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from msgs import Frame
from nodes.ros2_camera import Ros2Camera
from tests.support.patience import LONG, until
from tests.support.ros2_peer import OWN_DOMAIN, Peer

SIZE = 24, 32
K = [25.0, 0, 15.5, 0, 25.0, 11.5, 0, 0, 1]
INFO = {"height": 24, "width": 32, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": K, "p": [0.0] * 12}
IMAGE, COMPRESSED, CALIBRATION = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
Sender = Callable[..., None]


def stamp(seconds: float) -> dict[str, Any]:
    return {"stamp": {"sec": int(seconds), "nanosec": round(seconds % 1 * 1e9)}, "frame_id": "camera"}


def picture(number: int, time: float | None = None, size: tuple[int, int] = SIZE, **other: Any) -> dict[str, Any]:
    """mono8, of the brightness `number`."""
    header = stamp(1000 + number / 10 if time is None else time)
    data = [number % 256] * (size[0] * size[1])
    return {
        "header": header,
        "height": size[0],
        "width": size[1],
        "encoding": "mono8",
        "step": size[1],
        "data": data,
    } | other


def config(camera: str, **other: Any) -> Ros2Camera.Config:
    given: dict[str, Any] = {"path": f"{camera}/image_raw", "domain": OWN_DOMAIN, "timeout": 3.0}
    return Ros2Camera.Config(**(given | other))


def looked_at(node: Ros2Camera) -> int:
    """Images that it took or refused so far."""
    counts = ("frames", "unusable", "refused_messages", "before_calibration")
    return int(sum(node.stats.counts.get(count, 0) for count in counts))


def wait_until_looked_at(node: Ros2Camera, images: int) -> None:
    until(lambda: looked_at(node) == images)


def received(config: Ros2Camera.Config, send: Sender, frames: int = 0) -> tuple[list[Frame], Ros2Camera]:
    """What the node makes of what `send` publishes once it listens. frames: with which it ends; 0: with silence, and
    each image waits until it has looked at the one before."""
    node = Ros2Camera(config)
    node.config = replace(config, timeout=LONG)  # until they have met, the machine may be busy
    thread = threading.Thread(target=send, args=() if frames else (node,), daemon=True)
    thread.start()
    taken = []
    stream = node.run()
    for message in stream:
        if isinstance(message, Frame):
            node.config = config
            taken.append(message)
            if len(taken) == frames:
                break
    stream.close()  # type: ignore[attr-defined]
    thread.join()
    return taken, node


def sender(
    peer: Peer, camera: str, messages: list[Any], info: dict[str, Any] | None = INFO, interval: float = 0.03,
    name: str = IMAGE, topic: str = "image_raw", later: tuple[int, dict[str, Any]] | None = None,
) -> Sender:  # fmt: skip
    """Sends the calibration with every image, as drivers do; in step with a node that it is given.

    later: the calibration from an image of this number on.
    """
    images, infos = f"{camera}/{topic}", f"{camera}/camera_info"
    peer.advertise(images, name)
    peer.advertise(infos, CALIBRATION)

    def send(node: Ros2Camera | None = None) -> None:
        peer.wait_for_reader(images)
        peer.wait_for_reader(infos)
        if node is not None:  # what comes before it knows of the sender is lost
            until(lambda: hasattr(node, "_infos") and node._images.writers and node._infos.writers)
        for number, message in enumerate(messages, start=1):
            calibration = info if later is None or number < later[0] else later[1]
            if calibration is not None:
                peer.publish(infos, {"header": stamp(0.0), **calibration})
            if isinstance(message, bytes):
                peer.publish_raw(images, message)
            else:
                peer.publish(images, message)
            time.sleep(interval)
            if node is not None:
                wait_until_looked_at(node, number)

    return send


def numbers(frames: list[Frame]) -> list[int]:
    return [int(frame.image[0, 0, 0]) for frame in frames]
