"""Stages of the fake graph that take their time to save and to end, or do not end well."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from msgs import Poses
from tests.support.fake_graph.stages import Relay, Sink


class SlowToSave(Relay):
    """Takes a second of the three that it has to write `saved`, where the run ends early for it."""

    @dataclass
    class Config(Relay.Config):
        saved: Path = Path("saved")

    config: Config

    def on_abort(self, reason: str) -> None:
        time.sleep(1.0)
        self.config.saved.write_text(reason)


class SlowToEnd(Sink):
    """Works on once its inputs have ended, as a mapper refines, until `goes` is there; then writes what a sink does."""

    @dataclass
    class Config(Sink.Config):
        goes: Path = Path("goes")

    config: Config

    def on_end(self) -> Iterator[None]:
        while not self.config.goes.exists():
            time.sleep(0.01)
        yield from super().on_end()


class DiesAtTheEnd(Relay):
    """Is killed once its inputs have ended, as a mapper that refines."""

    def on_end(self) -> Iterator[Poses]:
        os.kill(os.getpid(), signal.SIGKILL)
        yield from ()
