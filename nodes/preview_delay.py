"""How long the keyframes of a live stream wait until a preview shows them."""

from __future__ import annotations

from collections.abc import Iterator, Set

from msgs import FusedKeyframe, Keyframe


class PreviewDelay:
    """Of keyframes alone, the newest is read; with their depth, all come, in order. Each counts once, as soon as a
    preview shows it either way."""

    def __init__(self) -> None:
        self._waiting: dict[int, float] = {}  # keyframes that no preview showed yet: when they were captured
        self._early: set[int] = set()  # those that one showed whose depth is still to come
        self._newest = -1  # whose depth has come

    def came(self, keyframe: FusedKeyframe | Keyframe) -> None:
        index, early = keyframe.index, keyframe.index in self._early
        if isinstance(keyframe, FusedKeyframe):
            self._newest = max(self._newest, index)
            self._early = {k for k in self._early if k > self._newest}
        elif index <= self._newest:
            return
        if not early:
            self._waiting.setdefault(index, keyframe.captured)

    def shown(self, keyframes: Set[int]) -> Iterator[float]:
        """A preview shows these: when those of them were captured that none has shown before."""
        for index in self._waiting.keys() & keyframes:
            if index > self._newest:
                self._early.add(index)
            yield self._waiting.pop(index)


__all__ = ["PreviewDelay"]
