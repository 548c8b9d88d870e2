"""Who watches a run without a browser: `viewer=viser viewer._target_=bench.live.watcher.Watcher`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from msgs import Preview, TrackerPhase
from nodes import Node


class Watcher(Node):
    """Counts previews, so that they are made."""

    @dataclass
    class Config:
        pass

    def on_preview(self, preview: Preview) -> Iterator[None]:
        self.stats.count("previews")
        yield from ()

    def on_tracker_phase(self, message: TrackerPhase) -> Iterator[None]:
        yield from ()
