"""Keyframes that wait for the rest of their splats, in a checkpoint: what is kept of them, in half precision."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvsgs_core.array_file import Arrays
from mvsgs_core.mapping.coarse import Kept
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView

INDEX = "waiting"  # array of their keyframes, in the order in which they wait
ROWS: dict[str, type] = {"scale": np.float64, "unit": np.float64, "none": np.bool_}


def waiting_arrays(waiting: Sequence[Kept]) -> dict[str, np.ndarray]:
    """What `waiting_of` reads."""
    arrays = {
        INDEX: np.array([kept.keyframe.index for kept in waiting], np.int64),
        f"{INDEX}/scale": np.array([kept.keyframe.scale for kept in waiting], np.float64),
        f"{INDEX}/unit": np.array([kept.unit for kept in waiting], np.float64),
        f"{INDEX}/none": np.array([kept.none for kept in waiting], np.bool_),
    }
    for k, kept in enumerate(waiting):
        maps = ("depth", "unfiltered", "confidence", "normals")
        given = {"image": kept.image, **{name: getattr(kept.keyframe, name) for name in maps}}
        arrays |= {f"{INDEX}/{k}/{name}": value for name, value in given.items() if value is not None}
    return arrays


def waiting_of(arrays: Arrays, views: Sequence[TrainingView]) -> list[Kept]:
    """Of a map with these keyframes. Raises ValueError for damage."""
    index, within, known = arrays.take(INDEX, np.int64, (None,)), arrays.of(INDEX), {v.index: v for v in views}
    if len(set(index.tolist())) < len(index) or not set(index.tolist()) <= known.keys():
        raise ValueError("keyframes that wait for their splats are not there")
    rows = {name: within.take(name, dtype, (len(index),)) for name, dtype in ROWS.items()}
    if (rows["scale"] <= 0).any() or (rows["unit"] <= 0).any():
        raise ValueError("keyframes that wait for their splats have scales that none has")
    return [
        _kept(within.of(str(k)), known[i], *(rows[name][k].item() for name in ROWS))
        for k, i in enumerate(index.tolist())
    ]


def _kept(arrays: Arrays, view: TrainingView, scale: float, unit: float, none: bool) -> Kept:
    depth = arrays.take("depth", np.float16, (None, None))
    if not depth.size:
        raise ValueError("a keyframe that waits for its splats has no depth")

    def beside(name: str, *values: int) -> np.ndarray | None:
        return arrays.take(name, np.float16, (*depth.shape, *values)) if name in arrays else None

    image = arrays.take("image", np.uint8, (*view.image_size, 3)) if "image" in arrays else None
    nothing = np.zeros((0, 0, 3), np.uint8)
    keyframe = RGBDKeyframe(
        view.index, nothing, view.image_intrinsics, view.world_from_cam, depth, scale,
        confidence=beside("confidence"), normals=beside("normals", 3), unfiltered=beside("unfiltered"),
    )  # fmt: skip
    return Kept(keyframe, unit, none, image)


__all__ = ["waiting_arrays", "waiting_of"]
