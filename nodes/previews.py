"""Previews of a map: whether anybody wants one, when the next is due, and what one of a growing map shows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msgs import FusedKeyframe, Keyframe, Poses, Preview
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.preview import preview_arrays
from mvsgs_core.mapping.provisional import Provisional
from mvsgs_core.setting_ranges import at_least
from nodes import Node
from nodes.mapped_messages import coarse_keyframe
from nodes.preview_delay import PreviewDelay
from nodes.runtime.status import rss

PREVIEWS = 0.1  # of the time that previews may take in real time


@dataclass(frozen=True)
class PreviewConfig(MapperConfig):
    """Of a mapper that sends previews."""

    preview_period: float = 1.0  # seconds between previews; 0: none
    preview_splats: int = 100000  # at most so many in a preview

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, preview_period=0, preview_splats=1)


class Previews:
    """Those that a node sends."""

    def __init__(self, node: Node, config: PreviewConfig) -> None:
        self._node, self._config = node, config
        self._begun = 0.0  # the last one, by time.monotonic
        self.seconds = 0.0  # that it took

    @property
    def wanted(self) -> bool:
        return self._config.preview_period > 0 and Preview not in self._node.unread

    @property
    def due(self) -> bool:
        period = max(self._config.preview_period, self.seconds / PREVIEWS if self._config.realtime else 0.0)
        return self.wanted and time.monotonic() - self._begun >= period

    def begin(self) -> None:
        """The next one is due a period after now."""
        self._begun = time.monotonic()


class GrowingPreviews(Previews):
    """Until a keyframe's FusedKeyframe comes, its coarse depth stands in.

    Of a live stream it is measured how long keyframes wait until one shows them.
    """

    def __init__(self, node: Node, config: PreviewConfig) -> None:
        super().__init__(node, config)
        self.unshown = False  # a map that was begun on and that none showed yet
        self._live = False  # keyframes come with the time of their capture
        self._efforts = 0, 0  # that stereo and fusion made for the newest keyframe
        self.begin_anew()

    def begin_anew(self) -> None:
        """With another map."""
        self._provisional, self._delay = Provisional(self._config.preview_splats), PreviewDelay()

    def came(self, fused: FusedKeyframe) -> None:
        """Its coarse depth is needed no more."""
        self._provisional.came(fused.index)

    def mapped(self, fused: FusedKeyframe) -> None:
        self._efforts = fused.effort, fused.fusion_effort
        self._wait(fused)

    def see(self, keyframe: Keyframe) -> None:
        """One that the map does not have yet."""
        self._wait(keyframe)
        self._provisional.see(coarse_keyframe(keyframe))

    def correct(self, poses: Poses) -> None:
        self._provisional.correct(poses.index, poses.world_from_cam, poses.scale, poses.segment)

    def of(self, atlas: Atlas, due: bool = False) -> Iterator[Preview]:
        """One, where it is due, as it also is where the caller says so, and there is something to show."""
        mapper = atlas.current
        if not self.wanted or not (due or self.due) or not mapper.views or not len(mapper.state):
            return
        self.begin()
        self.unshown = False
        stats = self._node.stats
        with stats.time("provisional"):
            provisional = self._provisional.splats(mapper, atlas.segments)
        live = stats.latency("keyframe to map", "keyframe to preview") if self._live else None
        arrays = preview_arrays(mapper, self._config.preview_splats, provisional)
        self.seconds = time.monotonic() - self._begun
        yield Preview(
            **arrays,
            latency=None if live is None else np.array(live),
            effort=self._efforts[0],
            fusion_effort=self._efforts[1],
            memory=rss(),
            coarse=len(mapper.coarse),
        )
        shown = {view.index for view in mapper.views} | self._provisional.shown
        for captured in self._delay.shown(shown):
            stats.arrived("keyframe to preview", captured)

    def _wait(self, keyframe: FusedKeyframe | Keyframe) -> None:
        if keyframe.captured > 0.0:
            self._live = True
            if self.wanted:
                self._delay.came(keyframe)


__all__ = ["GrowingPreviews", "PreviewConfig", "Previews"]
