"""Mapping that has begun, small enough to be saved and loaded often."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mvsgs_core import geometry
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.between import FrameBetween
from mvsgs_core.mapping.checkpoints.writer import CheckpointWriter
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.mapper import OnlineMapper
from tests.support.patience import LONG
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (24, 32)


PLAIN = MapperConfig(iterations=10, refinement=6, window=2, threads=1, device="cpu")


VIGNETTING = np.array([-0.05, 0.0, 0.01], np.float32)


def gain(factor: float) -> np.ndarray:
    """(3, 4) exposure."""
    return np.diag([factor, factor, 0.9 * factor, 0.0])[:3].astype(np.float32)


def view(index: int) -> RGBDKeyframe:
    """The first has no exposure yet."""
    found = rgbd_keyframe(index, pose_on_arc(index / 8), SIZE)
    found = replace(found, exposure=gain(1.0 + 0.02 * index) if index else None, vignetting=VIGNETTING)
    if index != 1:
        return replace(found, timestamp=0.1 * index)
    image = found.image.astype(np.float32) / np.float32(255)
    image[3:6, 4:9] = np.nan  # pixels to leave out
    return replace(found, image=image, timestamp=0.1)


def between(index: int, keyframe: int) -> FrameBetween:
    """A frame that is no keyframe, seen from another that is."""
    found = rgbd_keyframe(index, pose_on_arc(index / 8), SIZE)
    relative = geometry.inverse(pose_on_arc(keyframe / 8)) @ pose_on_arc(index / 8)
    return FrameBetween(index, 0.1 * index, found.image, found.intrinsics, keyframe, relative, 1.0)


def begun(config: MapperConfig) -> Atlas:
    """Two segments, frames between keyframes, corrections of poses and exposures, and iterations still pending."""
    atlas = Atlas(OnlineMapper(config))
    for index in range(6):
        atlas.enter(int(index == 3))
        atlas.current.add_keyframe(view(index))
        atlas.came(index, 0.1 * index)
        atlas.add_between(replace(between(20 + index, index), exposure=gain(1.0 + 0.01 * index)))
        atlas.take_between()
        for _ in range(4):
            atlas.current.step()
    moved = pose_on_arc(0.3)
    moved[:3, 3] += 0.02
    exposures = np.stack([gain(1.1), gain(1.2)])
    atlas.correct(np.array([2, 7]), np.stack([moved, moved]), np.array([1.1, 1.2]), None, exposures, 2.0 * VIGNETTING)
    atlas.segment_of.update({3: 1, 2: 0})
    atlas.revision = 4
    return atlas


def written(atlas: Atlas, output: Path) -> Path:
    """The folder with its checkpoint."""
    writer = CheckpointWriter(output, atlas.current.config)
    writer.submit(atlas.frozen(), sync=False)
    assert writer.wait(LONG)
    assert writer.problems.empty(), writer.problems.get()
    return output
