"""Nodes that watch, in a process that may write no more than a few kilobytes to a file: as on a full disk."""

from __future__ import annotations

import resource
import signal
from typing import Any

from nodes.evaluator import Evaluator
from nodes.recorder import Recorder

FILE_BYTES = 200_000


def fill_the_disk() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # an OSError instead, as "no space left on device" is one
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))


class FullRecorder(Recorder):
    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        fill_the_disk()


class FullEvaluator(Evaluator):
    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        fill_the_disk()
