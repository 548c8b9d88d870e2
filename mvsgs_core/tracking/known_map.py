"""The tracker's half of a map that is kept: its keyframes with their matches, from which another stream is tracked.

A keyframe has its image at the tracker's size, its pose, the inverse depths of its points and where they were found in
others; what is computed from the image (points, features) is computed again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mvsgs_core.array_file import Arrays, read_arrays, write_arrays
from mvsgs_core.atomic_file import replacing
from mvsgs_core.camera import is_readout_time
from mvsgs_core.photometry import is_exposure, is_vignetting
from mvsgs_core.tracking.graph import Edge, Keyframe, KeyframeGraph
from mvsgs_core.tracking.image import CELL, TrackingImage
from mvsgs_core.tracking.publish import Publisher

FORMAT, VERSION = "mvsgs tracker", 3
WHAT = "tracker's half of a map"


@dataclass(frozen=True)
class KnownMap:
    """What a tracker goes on in."""

    size: tuple[int, int]  # height, width of the tracker's images
    intrinsics: np.ndarray  # (4,) at that size
    readout_time: float  # seconds of the camera's rolling shutter
    reads_columns: bool  # it reads columns, not rows
    vignetting: np.ndarray  # (3,) as the graph has it, of log V
    published_vignetting: np.ndarray  # (3,) as readers have it, see `msgs`; zeros: none
    keyframes: list[Keyframe]  # in the order of the stream
    exposures: dict[int, np.ndarray]  # (3, 4) as readers have them, by keyframe; none where light was steady
    edges: dict[tuple[int, int], Edge]
    # by keyframe, depths over those when it was first published, for who goes on in the same run; none: 1
    scales: dict[int, float] = field(default_factory=dict)

    @property
    def segments(self) -> set[int]:
        return {keyframe.segment for keyframe in self.keyframes}

    def renumbered(self, frames: int) -> KnownMap:
        """The same for another run, of frames whose indices are so many lower."""
        keyframes = [_renumbered(keyframe, frames) for keyframe in self.keyframes]
        exposures = {index - frames: exposure for index, exposure in self.exposures.items()}
        edges = {(a - frames, b - frames): edge for (a, b), edge in self.edges.items()}
        return KnownMap(
            self.size, self.intrinsics, self.readout_time, self.reads_columns, self.vignetting,
            self.published_vignetting, keyframes, exposures, edges,
        )  # fmt: skip


def save(file: Path, graph: KeyframeGraph, publisher: Publisher, vignetting: np.ndarray | None) -> None:
    """Writes the keyframes that were published, as they are now; vignetting (3,): what readers have, None: none.

    Raises OSError; ValueError where there is none.
    """
    order = sorted(publisher.published & graph.keyframes.keys())
    if not order:
        raise ValueError("there is no keyframe to keep a map of")
    keyframes = [graph.keyframes[index] for index in order]
    images = [keyframe.image for keyframe in keyframes]
    height, width = images[0].size
    pairs = [pair for pair in graph.edges if pair[0] in graph.keyframes and set(pair) <= set(order)]
    edges = [graph.edges[pair] for pair in pairs]
    points = len(keyframes[0].inverse_depth)
    arrays = {
        "intrinsics": graph.intrinsics,
        "vignetting": graph.vignetting,
        "published_vignetting": np.zeros(3) if vignetting is None else vignetting.astype(np.float64),
        "index": np.array(order, np.int64),
        "segment": np.array([keyframe.segment for keyframe in keyframes], np.int32),
        "timestamp": np.array([image.timestamp for image in images], np.float64),
        "cam_from_world": np.stack([keyframe.cam_from_world for keyframe in keyframes]),
        "inverse_depth": np.stack([keyframe.inverse_depth for keyframe in keyframes]),
        "information": np.stack([keyframe.information for keyframe in keyframes]),
        "static": np.stack([keyframe.static for keyframe in keyframes]).astype(np.float32),
        "gray": np.stack([image.gray for image in images]),
        "half_color": _stacked([image.half_color for image in images], (height // 2, width // 2, 3), np.uint8, 0),
        "color": _stacked([image.color for image in images], (height, width, 3), np.uint8, 0),
        "velocity": _stacked([i.velocity for i in images], (height // CELL, width // CELL, 2), np.float32, np.nan),
        "light": np.array([image.exposure for image in images], np.float64),
        "exposure": _stacked([publisher.exposure(index) for index in order], (3, 4), np.float32, np.nan),
        "scale": np.array([publisher.scale(index) for index in order], np.float64),
        "edges": np.array(pairs, np.int64).reshape(-1, 2),
        "target": np.array([edge.target for edge in edges], np.float32).reshape(-1, 2, points),
        "weight": np.array([edge.weight for edge in edges], np.float16).reshape(-1, points),
        "fraction": np.array([edge.fraction for edge in edges], np.float64),
    }
    if any(image.mask is not None for image in images):
        whole = np.ones((height, width), bool)
        arrays["mask"] = np.stack([whole if image.mask is None else image.mask for image in images])
    meta = {"size": [height, width], "readout_time": graph.readout_time, "reads_columns": graph.reads_columns}
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as aside:
        write_arrays(aside, FORMAT, VERSION, meta, {name: np.ascontiguousarray(a) for name, a in arrays.items()})


def load(file: Path) -> KnownMap:
    """Raises ValueError, saying what is wrong, for what is no whole file of this version."""
    meta, raw = read_arrays(file, FORMAT, VERSION, WHAT)
    try:
        return _unpacked(meta, Arrays(raw))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file} is damaged: {error}") from error


def _unpacked(meta: dict[str, object], arrays: Arrays) -> KnownMap:
    size, readout_time = meta.get("size"), meta.get("readout_time")
    if not (
        isinstance(size, list) and len(size) == 2 and all(type(n) is int and n > 0 and n % CELL == 0 for n in size)
    ):
        raise ValueError(f"{size!r} is no size of the tracker's images")
    if type(readout_time) is not float or not is_readout_time(readout_time):
        raise ValueError(f"{readout_time!r} is no readout time")
    reads_columns = meta.get("reads_columns")
    if type(reads_columns) is not bool:
        raise ValueError(f"{reads_columns!r} does not say whether columns are read")
    height, width = size
    index = arrays.take("index", np.int64, (None,))
    count, points = len(index), (height // CELL) * (width // CELL)
    if count == 0 or (np.diff(index) <= 0).any():
        raise ValueError("its keyframes are none, or not in order")
    poses = arrays.take("cam_from_world", np.float64, (count, 4, 4))
    rotations = poses[:, :3, :3]
    turned = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if turned > 1e-6 or not (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all() or (np.linalg.det(rotations) < 0.0).any():
        raise ValueError("its keyframes have poses that are none")
    inverse_depth = arrays.take("inverse_depth", np.float64, (count, points))
    information = arrays.take("information", np.float64, (count, points))
    if (inverse_depth <= 0).any() or (information < 0).any():
        raise ValueError("its keyframes have depths that are none")
    static = arrays.take("static", np.float32, (count, points)).astype(np.float64)
    if (static < 0).any() or (static > 1).any():
        raise ValueError("its keyframes have points that stand still more than wholly, or less than not at all")
    intrinsics = arrays.take("intrinsics", np.float64, (4,))
    if (intrinsics[:2] <= 0).any():
        raise ValueError("its intrinsics are none")
    segment, timestamp = arrays.take("segment", np.int32, (count,)), arrays.take("timestamp", np.float64, (count,))
    gray, light = arrays.take("gray", np.uint8, (count, height, width)), arrays.take("light", np.float64, (count,))
    half_color = _all_or_none(arrays, "half_color", count, (height // 2, width // 2, 3), np.uint8)
    color = _all_or_none(arrays, "color", count, (height, width, 3), np.uint8)
    velocity = _all_or_none(arrays, "velocity", count, (height // CELL, width // CELL, 2), np.float32)
    mask = _all_or_none(arrays, "mask", count, (height, width), np.bool_) if "mask" in arrays else [None] * count
    exposure = _all_or_none(arrays, "exposure", count, (3, 4), np.float32)
    scale = arrays.take("scale", np.float64, (count,))
    if (scale <= 0).any():
        raise ValueError("its keyframes have scales that are none")
    published_vignetting = arrays.take("published_vignetting", np.float64, (3,))
    exposures = {int(k): e for k, e in zip(index, exposure) if e is not None}
    if not all(is_exposure(e) for e in exposures.values()) or not is_vignetting(published_vignetting):
        raise ValueError("its keyframes have exposures or a vignetting that no camera has")
    keyframes = [
        Keyframe(
            TrackingImage(
                int(index[k]), float(timestamp[k]), gray[k], color[k], half_color[k], float(light[k]), velocity[k],
                mask[k],
            ),
            poses[k].copy(), inverse_depth[k].copy(), information[k].copy(), int(segment[k]),
        )
        for k in range(count)
    ]  # fmt: skip
    for keyframe, weights in zip(keyframes, static):
        keyframe.static = weights.copy()
    edges = _edges(arrays, {keyframe.index: keyframe.image for keyframe in keyframes}, points)
    vignetting = arrays.take("vignetting", np.float64, (3,)).copy()
    return KnownMap(
        (height, width), intrinsics.copy(), readout_time, reads_columns, vignetting, published_vignetting, keyframes,
        exposures, edges, dict(zip(index.tolist(), scale.tolist())),
    )  # fmt: skip


def _edges(arrays: Arrays, images: dict[int, TrackingImage], points: int) -> dict[tuple[int, int], Edge]:
    pairs = arrays.take("edges", np.int64, (None, 2))
    count = len(pairs)
    target = arrays.take("target", np.float32, (count, 2, points))
    weight = arrays.take("weight", np.float16, (count, points))
    fraction = arrays.take("fraction", np.float64, (count,))
    if not set(pairs.ravel().tolist()) <= images.keys() or (pairs[:, 0] == pairs[:, 1]).any() or (weight < 0).any():
        raise ValueError("matches are of keyframes that are not there, or weigh less than nothing")
    return {
        (int(a), int(b)): Edge(target[n], weight[n], images[b].velocity_at(target[n].T).T, float(fraction[n]))
        for n, (a, b) in enumerate(pairs.tolist())
    }


def _stacked(values: list[np.ndarray | None], shape: tuple[int, ...], dtype: type, missing: float) -> np.ndarray:
    """(K, *shape); no row at all where none is known, and for integers where any is not."""
    known = [value is not None for value in values]
    if not any(known) or not (all(known) or np.isnan(missing)):
        return np.zeros((0, *shape), dtype)
    return np.stack([np.full(shape, missing, dtype) if value is None else value.astype(dtype) for value in values])


def _all_or_none(arrays: Arrays, name: str, count: int, shape: tuple[int, ...], dtype: type) -> list[np.ndarray | None]:
    """What `_stacked` wrote, by keyframe."""
    found = arrays.take(name, dtype, (None, *shape), nan=True)
    if len(found) not in (0, count):
        raise ValueError(f"{name} is known of {len(found)} of {count} keyframes")
    return [None if not len(found) or _unknown(found[k]) else found[k] for k in range(count)]


def _unknown(value: np.ndarray) -> bool:
    return value.dtype.kind == "f" and bool(np.isnan(value).any())


def _renumbered(keyframe: Keyframe, frames: int) -> Keyframe:
    i = keyframe.image
    image = TrackingImage(i.index - frames, i.timestamp, i.gray, i.color, i.half_color, i.exposure, i.velocity, i.mask)
    renumbered = Keyframe(
        image, keyframe.cam_from_world, keyframe.inverse_depth, keyframe.information, keyframe.segment
    )
    renumbered.static = keyframe.static
    return renumbered


__all__ = ["KnownMap", "load", "save"]
