"""Source: the frames that a program hands over, for `Mapping`."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from msgs import Frame, GroundTruth
from nodes import Node


class Fed(Node):
    """`frames` -> Frame, GroundTruth. Its `run` ends where none is left, and is begun again when there are."""

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self.frames: deque[Frame | GroundTruth] = deque()

    @classmethod
    def check(cls, config: Any) -> None:
        raise ValueError(
            "its frames come from a program that runs `from mvsgs import Mapping`, not from a command line"
        )

    def run(self) -> Iterator[Frame | GroundTruth]:
        while self.frames:
            yield self.frames.popleft()
