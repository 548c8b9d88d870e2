"""Keyframes as the tracker gives them: its poses, its coarse depth, its scale."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from bench.depth.data import SOURCES, Scene, rendered_size
from bench.runs import DATA
from msgs import Frame, Keyframe, Poses
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.mvs.keyframe import StereoKeyframe, prepare_keyframe
from nodes.tracker import Tracker


class Collected:
    """Keyframes that a tracker sent, and their last corrected pose and scale, by index."""

    def __init__(self) -> None:
        self.keyframes: dict[int, Keyframe] = {}
        self._latest: dict[int, tuple[np.ndarray, float]] = {}

    def take(self, messages: Any) -> None:
        for message in messages:
            if isinstance(message, Keyframe):
                self.keyframes[message.index] = message
            elif isinstance(message, Poses):
                for i, pose, scale in zip(message.index, message.world_from_cam, message.scale, strict=True):
                    self._latest[int(i)] = (pose, float(scale))

    def views(self, area: int, scales: tuple[int, ...]) -> list[StereoKeyframe]:
        """In the stream's order, where the tracker has them at its end."""
        found = []
        for index, k in sorted(self.keyframes.items()):
            view = prepare_keyframe(
                index, k.image, k.intrinsics, k.world_from_cam, area=area, scales=scales, inverse_depth=k.inverse_depth,
                weight=k.inverse_depth_weight, scale=k.scale, segment=k.segment,
            )  # fmt: skip
            found.append(view.moved(*self._latest[index]) if index in self._latest else view)
        return found


@lru_cache(maxsize=2)
def _track(name: str, size: tuple[int, int] | None) -> tuple[dict[int, Item], Collected]:
    """Frames by index, and keyframes. size: of a rendered scene."""
    source = SOURCES[name]
    given = {"path": DATA / source.folder} if size is None else {"size": size}
    options = source.options | given
    items: dict[int, Item] = {}
    tracker, sent = Tracker(), Collected()
    for item in open_dataset(source.dataset, **options):
        items[item.index] = item
        sent.take(tracker.on_frame(Frame(item.index, item.timestamp, item.image, item.intrinsics)))
        if item.depth is None and item.index not in sent.keyframes:
            items[item.index] = replace(item, image=np.empty((0, 0, 3), np.uint8))
    sent.take(tracker.on_end())
    if not sent.keyframes:
        raise ValueError(f"{name}: the tracker gave no keyframe")
    return items, sent


def load_tracked(name: str, area: int, scales: tuple[int, ...] = (1, 2)) -> Scene:
    """The sequence's keyframes with the tracker's final poses, scaled to the truth by the median over all keyframes.

    Raises FileNotFoundError where the data is missing and ValueError where the tracker gave no keyframe.
    """
    items, sent = _track(name, rendered_size(area) if SOURCES[name].dataset == "synthetic" else None)
    views, truths, ratios = sent.views(area, scales), [], []
    for view in views:
        truth = items[view.index].depth
        if truth is not None:
            cells = cv2.resize(truth, view.inverse_depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            both = (cells > 0) & (view.inverse_depth > 0)
            ratios.append(cells[both] * view.inverse_depth[both])
            truth = cv2.resize(truth, view.size[::-1], interpolation=cv2.INTER_NEAREST)
        truths.append(truth)
    factor = float(np.median(np.concatenate(ratios)))
    scaled = []
    for view in views:
        pose = view.world_from_cam.copy()
        pose[:3, 3] *= factor
        scaled.append(view.moved(pose, view.scale * factor))
    kept = [items[view.index] for view in views]
    return Scene(f"{name}, tracked", kept, scaled, truths, SOURCES[name].tolerance)
