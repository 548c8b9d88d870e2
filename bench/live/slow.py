"""Stages that are slower than they need be, by a factor: `mvs._target_=bench.live.slow.SlowStereo mvs.factor=10`."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from nodes.depth_fusion import DepthFusion
from nodes.mapper import Mapper
from nodes.mvs import Mvs

P = ParamSpec("P")
T = TypeVar("T")


def slowed(work: Callable[P, T], factor: float) -> Callable[P, T]:
    """The same, and then nothing for `factor` - 1 times as long."""

    @functools.wraps(work)
    def slow(*args: P.args, **kwargs: P.kwargs) -> T:
        start = time.perf_counter()
        found = work(*args, **kwargs)
        time.sleep((factor - 1.0) * (time.perf_counter() - start))
        return found

    return slow


class SlowStereo(Mvs):
    @dataclass(frozen=True)
    class Config(Mvs.Config):
        factor: float = 10.0  # times as slow

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._core._estimate = slowed(self._core._estimate, self.config.factor)  # type: ignore[method-assign]


class SlowFusion(DepthFusion):
    @dataclass(frozen=True)
    class Config(DepthFusion.Config):
        factor: float = 10.0  # times as slow

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._core._fuse = slowed(self._core._fuse, self.config.factor)  # type: ignore[method-assign]


class SlowMapper(Mapper):
    """Takes keyframes in and iterates slowly; the refinement after the stream is not slow."""

    @dataclass(frozen=True)
    class Config(Mapper.Config):
        factor: float = 10.0  # times as slow

    config: Config

    def __init__(self, config: Config | None = None) -> None:
        super().__init__(config)
        self._add = slowed(self._add, self.config.factor)  # type: ignore[method-assign]
        self.atlas.step = slowed(self.atlas.step, self.config.factor)  # type: ignore[method-assign]
        self.atlas.begin_late = slowed(self.atlas.begin_late, self.config.factor)  # type: ignore[method-assign]
        made_up = self.atlas.make_up
        slowly = slowed(made_up, self.config.factor)
        self.atlas.make_up = lambda splats=True, rate=None: (  # type: ignore[method-assign]
            made_up(splats, rate) if self.atlas.stream_ended else slowly(splats, rate)
        )


__all__ = ["SlowFusion", "SlowMapper", "SlowStereo", "slowed"]
