"""Programs that send frames to a robot's node, in step with it: of a live stream it takes the newest only, and a frame
that comes while it is away takes the place of the one before."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import zmq

from msgs import Frame
from nodes.robot import Robot
from tests.support.patience import until

INTERVAL = 0.03  # s between two frames


def looked_at(robot: Robot) -> int:
    """Frames that it took or refused so far."""
    reader = getattr(robot, "_reader", None)
    return 0 if reader is None else reader.received + reader.refused


def wait_until_looked_at(robot: Robot, frames: int) -> None:
    until(lambda: looked_at(robot) == frames)


class Program:
    """A publisher that knows nothing of this project and sends what it is told, a frame every `INTERVAL`."""

    def __init__(self, robot: Robot, frames: Iterator[bytes], in_step: bool = True) -> None:
        """in_step: the next frame waits until the robot's node has looked at this one."""
        self._thread = threading.Thread(target=self._work, args=(robot, frames, in_step), daemon=True)
        self._stop = threading.Event()
        self._thread.start()

    def _work(self, robot: Robot, frames: Iterator[bytes], in_step: bool) -> None:
        with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
            publisher.linger = 200
            publisher.bind(robot.config.path)
            while not publisher.poll(100):  # until a reader has come
                if self._stop.is_set():
                    return
            for frame in frames:
                before = looked_at(robot)
                publisher.send(frame)
                if self._stop.wait(INTERVAL):
                    return
                while in_step and looked_at(robot) == before:  # after an end, which nothing follows, until it is closed
                    if self._stop.wait(0.001):
                        return
            self._stop.wait()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


def received(robot: Robot, frames: Iterator[bytes], in_step: bool = True) -> list[Frame]:
    """What the robot's node makes of a program's frames."""
    program = Program(robot, frames, in_step)
    try:
        return [message for message in robot.run() if isinstance(message, Frame)]
    finally:
        program.close()
