"""A mapper as arrays and JSON, and back to the bit: whoever goes on from it gets the map that would have been."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mvsgs_core.mapping.checkpoints.images import read_images
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.mapper import MapperConfig, OnlineMapper
from mvsgs_core.stats import Stats

Corrections = dict[int, tuple[np.ndarray, float]]

SPLATS: dict[str, tuple[type, tuple[int, ...]]] = {  # N splats: dtype and shape of a row, without harmonics
    "means": (np.float32, (3,)), "log_scales": (np.float32, (3,)), "quaternions": (np.float32, (4,)),
    "opacity_logits": (np.float32, ()), "betas": (np.float32, ()), "steps": (np.int32, ()), "anchors": (np.int64, ()),
    "means2d_gradient": (np.float32, ()), "means2d_views": (np.float32, ()),
}  # fmt: skip
VIEWS: dict[str, tuple[type, tuple[int, ...]]] = {  # K keyframes: as in TrainingView
    "index": (np.int64, ()), "timestamp": (np.float64, ()), "world_from_cam": (np.float64, (4, 4)),
    "scale": (np.float64, ()), "local_from_cam": (np.float64, (4, 4)), "image_intrinsics": (np.float64, (4,)),
    "image_size": (np.int64, (2,)), "exposure": (np.float32, (3, 4)), "exposure_moments": (np.float32, (2, 3, 4)),
    "pose_delta": (np.float64, (4, 4)), "pose_moments": (np.float64, (2, 6)), "pose_steps": (np.int64, ()),
    "fixed": (np.bool_, ()), "median_depth": (np.float64, ()), "visits": (np.int64, ()), "visits_full": (np.int64, ()),
    "loss_fast": (np.float64, ()), "loss_slow": (np.float64, ()),
}  # fmt: skip
MAY_BE_NAN = ("timestamp", "loss_fast", "loss_slow")


class Arrays:
    """The arrays of a state, each checked as it is taken. Every method raises ValueError for what does not fit."""

    def __init__(self, arrays: Mapping[str, np.ndarray], prefix: str = "") -> None:
        self._arrays, self._prefix = arrays, prefix

    def of(self, prefix: str) -> Arrays:
        return Arrays(self._arrays, f"{self._prefix}{prefix}/")

    def take(self, name: str, dtype: type, shape: tuple[int | None, ...], *, nan: bool = False) -> np.ndarray:
        """An array of this dtype and shape (None: any size), finite unless NaN is allowed."""
        full = self._prefix + name
        value = self._arrays.get(full)
        if value is None:
            raise ValueError(f"{full} is missing")
        fits = len(value.shape) == len(shape) and all(s is None or s == n for s, n in zip(shape, value.shape))
        if value.dtype != dtype or not fits:
            wanted = f"{np.dtype(dtype)} {shape}"
            raise ValueError(f"{full} is {value.dtype} {value.shape}: expected {wanted}")
        if value.dtype.kind == "f" and (np.isinf(value).any() or (not nan and np.isnan(value).any())):
            raise ValueError(f"{full} has values that are not finite")
        return value


def copy_of(mapper: OnlineMapper, log: Stats, corrections: Corrections) -> OnlineMapper:
    """A mapper on the CPU that shares nothing that changes: what is saved while the other goes on.

    Raises ValueError where what is kept of the splats is not of one length: an iteration was cut off.
    """
    lengths = {len(value) for value in mapper.state.tensors().values()}
    if len(lengths) > 1:
        raise ValueError(f"the map is in the middle of a change: {sorted(lengths)} splats")
    cpu = torch.device("cpu")
    copied = OnlineMapper(replace(mapper.config, device="cpu"), log, corrections)
    copied.state = MapState.of(mapper.state.tensors(), cpu)
    copied.views = [_copied(view) for view in mapper.views]
    copied.with_image = [view for view in copied.views if view.levels]
    copied.schedule.restore(mapper.schedule.state(), len(copied.with_image))
    copied.iterations, copied.global_rate = mapper.iterations, mapper.global_rate
    copied.origin, copied.unit = mapper.origin, mapper.unit
    copied.generator.set_state(mapper.generator.get_state())
    return copied


def pack(mapper: OnlineMapper, prefix: str, names: list[list[str]]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """JSON and arrays of a mapper; `names`: the image files of each of its keyframes."""
    arrays = {f"{prefix}/splats/{name}": value.cpu().numpy() for name, value in mapper.state.tensors().items()}
    views = mapper.views
    for name, (dtype, shape) in VIEWS.items():
        rows = [_plain(getattr(view, name)) for view in views]
        arrays[f"{prefix}/views/{name}"] = np.array(rows, dtype=dtype).reshape(len(views), *shape)
    levels = mapper.config.skipping.levels
    arrays[f"{prefix}/views/intrinsics"] = np.array([view.intrinsics for view in views]).reshape(len(views), levels, 4)
    arrays[f"{prefix}/origin"] = np.zeros(0) if mapper.origin is None else mapper.origin
    arrays[f"{prefix}/generator"] = mapper.generator.get_state().numpy()
    meta = {
        "iterations": mapper.iterations, "unit": mapper.unit, "global_rate": mapper.global_rate,
        "schedule": mapper.schedule.state(), "images": names,
    }  # fmt: skip
    return meta, {name: np.ascontiguousarray(value) for name, value in arrays.items()}


def unpack(
    meta: Any, arrays: Arrays, config: MapperConfig, log: Stats, corrections: Corrections, images: Path
) -> OnlineMapper:
    """The mapper that was packed. images: the folder of its keyframes' images. Raises ValueError for damage."""
    if not isinstance(meta, dict):
        raise ValueError("a mapper's part is no object")
    mapper = OnlineMapper(config, log, corrections)
    mapper.views = _views(arrays.of("views"), meta.get("images"), config, images)
    mapper.with_image = [view for view in mapper.views if view.levels]
    mapper.state = _splats(arrays.of("splats"), mapper)
    mapper.schedule.restore(_object(meta.get("schedule")), len(mapper.with_image))
    mapper.iterations = whole(meta.get("iterations"), "iterations")
    mapper.global_rate = _positive(meta.get("global_rate"))
    mapper.unit = None if meta.get("unit") is None else _positive(meta.get("unit"))
    origin = arrays.take("origin", np.float64, (None,))
    if len(origin) not in (0, 3) or (len(origin) == 0 and (mapper.views or mapper.unit is not None)):
        raise ValueError("the origin is no position")
    mapper.origin = origin.copy() if len(origin) else None
    if mapper.unit is None and len(mapper.state):
        raise ValueError("there are splats, but no unit of length")
    try:
        mapper.generator.set_state(torch.from_numpy(arrays.take("generator", np.uint8, (None,)).copy()))
    except RuntimeError as error:
        raise ValueError(f"no state of a random generator: {error}") from error
    return mapper


def whole(value: Any, name: str) -> int:
    """A number of something. Raises ValueError for what is none."""
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{name} is {value!r}: expected a whole number of at least 0")
    return value


def _splats(arrays: Arrays, mapper: OnlineMapper) -> MapState:
    count = len(arrays.take("steps", np.int32, (None,)))
    rows = SPLATS | {"sh": (np.float32, ((mapper.config.sh_degree + 1) ** 2, 3))}
    parameters = list(mapper.state.first)
    found = {name: arrays.take(name, dtype, (count, *shape)) for name, (dtype, shape) in rows.items()}
    for name in parameters:
        dtype, shape = rows[name]
        for moment in ("first", "second"):
            found[f"{moment}/{name}"] = arrays.take(f"{moment}/{name}", dtype, (count, *shape))
    if count and not np.isin(found["anchors"], [view.index for view in mapper.views]).all():
        raise ValueError("splats are anchored to keyframes that are not there")
    if (found["steps"] < 0).any() or any((found[f"second/{name}"] < 0).any() for name in parameters):
        raise ValueError("splats have ages or squares below 0")
    # copied to memory that torch aligned: with other vectors a sum may round otherwise
    return MapState.of({name: torch.from_numpy(value.copy()) for name, value in found.items()}, mapper.state.device)


def _views(arrays: Arrays, images: Any, config: MapperConfig, folder: Path) -> list[TrainingView]:
    count, levels = len(arrays.take("index", np.int64, (None,))), config.skipping.levels
    columns = {
        name: arrays.take(name, dtype, (count, *shape), nan=name in MAY_BE_NAN)
        for name, (dtype, shape) in VIEWS.items()
    }
    intrinsics = arrays.take("intrinsics", np.float64, (count, levels, 4))
    sensible = all((columns[n] >= 0).all() for n in ("pose_steps", "visits", "visits_full", "median_depth"))
    if not (sensible and (columns["image_size"] > 0).all() and (columns["scale"] > 0).all()):
        raise ValueError("keyframes have sizes, scales or counts that none has")
    if not (isinstance(images, list) and len(images) == count and all(_is_names(names, levels) for names in images)):
        raise ValueError("not every keyframe's images are named")
    device, views = torch.device(config.device), []
    for k in range(count):
        row = {name: value[k] for name, value in columns.items()}
        pyramid, valid = read_images(folder, images[k], device)
        moments = torch.from_numpy(row["exposure_moments"].copy()).to(device)
        views.append(
            TrainingView(
                index=int(row["index"]), levels=pyramid, intrinsics=list(intrinsics[k].copy()),
                image_intrinsics=row["image_intrinsics"].copy(), image_size=_pair(row["image_size"]),
                timestamp=float(row["timestamp"]), world_from_cam=row["world_from_cam"].copy(),
                scale=float(row["scale"]), local_from_cam=row["local_from_cam"].copy(),
                exposure=torch.from_numpy(row["exposure"].copy()).to(device),
                exposure_moments=(moments[0].clone(), moments[1].clone()), pose_delta=row["pose_delta"].copy(),
                pose_moments=row["pose_moments"].copy(), pose_steps=int(row["pose_steps"]), fixed=bool(row["fixed"]),
                median_depth=float(row["median_depth"]), valid=valid, visits=int(row["visits"]),
                visits_full=int(row["visits_full"]), loss_fast=float(row["loss_fast"]),
                loss_slow=float(row["loss_slow"]),
            )
        )  # fmt: skip
    return views


def _copied(view: TrainingView) -> TrainingView:
    """On the CPU; images are shared, as they never change."""
    cpu = torch.device("cpu")
    first, second = (moment.to(cpu, copy=True) for moment in view.exposure_moments)
    return replace(
        view, levels=list(view.levels), valid=None if view.valid is None else list(view.valid),
        exposure=view.exposure.detach().to(cpu, copy=True), exposure_moments=(first, second),
        pose_delta=view.pose_delta.copy(), pose_moments=view.pose_moments.copy(),
    )  # fmt: skip


def _plain(value: Any) -> Any:
    """As numpy takes it."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return value


def _pair(values: np.ndarray) -> tuple[int, int]:
    return int(values[0]), int(values[1])


def _is_names(names: Any, levels: int) -> bool:
    return isinstance(names, list) and len(names) in (0, levels) and all(isinstance(name, str) for name in names)


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("an object is missing")
    return value


def _positive(value: Any) -> float:
    if type(value) is not float or not (math.isfinite(value) and value > 0):
        raise ValueError(f"{value!r} is no positive number")
    return value
