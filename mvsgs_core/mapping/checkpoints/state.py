"""A mapper as arrays and JSON, and back to the bit: whoever goes on from it gets the map that would have been."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch

from mvsgs_core.array_file import Arrays
from mvsgs_core.devices import resolve_device
from mvsgs_core.mapping.between import BetweenView
from mvsgs_core.mapping.checkpoints.waiting import waiting_arrays, waiting_of
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.exposure import ImageFormation
from mvsgs_core.mapping.keyframe_store import awake
from mvsgs_core.mapping.keyframes import CELLS, TrainingView, exposure_of
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.resting_images import bytes_of, rest, room_of
from mvsgs_core.photometry import is_exposure, is_vignetting
from mvsgs_core.stats import Stats

Corrections = dict[int, tuple[np.ndarray, float]]
V = TypeVar("V", bound=TrainingView)

SPLATS: dict[str, tuple[type, tuple[int, ...]]] = {  # N splats: dtype and shape of a row, without harmonics
    "means": (np.float32, (3,)), "log_scales": (np.float32, (3,)), "quaternions": (np.float32, (4,)),
    "opacity_logits": (np.float32, ()), "betas": (np.float32, ()), "steps": (np.int32, ()), "anchors": (np.int64, ()),
    "means2d_gradient": (np.float32, ()), "means2d_views": (np.float32, ()),
}  # fmt: skip
VIEWS: dict[str, tuple[type, tuple[int, ...]]] = {  # K keyframes: as in TrainingView
    "index": (np.int64, ()), "timestamp": (np.float64, ()), "world_from_cam": (np.float64, (4, 4)),
    "scale": (np.float64, ()), "local_from_cam": (np.float64, (4, 4)), "image_intrinsics": (np.float64, (4,)),
    "image_size": (np.int64, (2,)), "measured": (np.float32, (3, 4)),
    "pose_delta": (np.float64, (4, 4)), "pose_moments": (np.float64, (2, 6)), "pose_steps": (np.int64, ()),
    "velocity": (np.float64, (6,)), "readout_time": (np.float64, ()), "reads_columns": (np.bool_, ()),
    "as_taken": (np.bool_, ()),
    "fixed": (np.bool_, ()),
    "median_depth": (np.float64, ()), "mean_color": (np.float64, (3,)), "visits": (np.int64, ()),
    "visits_here": (np.int64, ()),
    "loss_fast": (np.float64, ()), "loss_slow": (np.float64, ()), "loss_before": (np.float64, ()),
    "intrinsics": (np.float64, (4,)), "surface": (np.float16, (3, CELLS, CELLS)),
}  # fmt: skip
BETWEEN = {name: kept for name, kept in VIEWS.items() if name != "surface"} | {  # frames between, as in BetweenView
    "keyframe": (np.int64, ()), "keyframe_from_cam": (np.float64, (4, 4)), "from_keyframe": (np.float32, (3, 4)),
    "twist": (np.float64, (6,)),
}  # fmt: skip
NEVER_BELOW_0 = ("pose_steps", "visits", "visits_here", "median_depth", "mean_color")
MAY_BE_NAN = ("timestamp", "loss_fast", "loss_slow", "loss_before", "measured", "surface")


def copy_of(
    mapper: OnlineMapper, log: Stats, corrections: Corrections, photometry: ImageFormation,
    splats: torch.Tensor | None = None, images: Collection[int] | None = None,
) -> OnlineMapper:  # fmt: skip
    """A mapper on the CPU that shares nothing that changes: what is saved while the other goes on.

    splats: (N,) bool, those that are wanted; images: keyframes, by index, whose images are, with the frames between
    them; None: all.

    Raises ValueError where what is kept of the splats is not of one length: an iteration was cut off.
    """
    lengths = {len(value) for value in mapper.state.tensors().values()}
    if len(lengths) > 1:
        raise ValueError(f"the map is in the middle of a change: {sorted(lengths)} splats")
    tensors = mapper.state.tensors()
    if splats is not None and not bool(splats.all()):
        tensors = {name: value[splats.to(value.device)] for name, value in tensors.items()}
    state = MapState.of(tensors, torch.device("cpu"))
    views = [_copied(view) for view in mapper.views]
    between = [_copied(view) for view in mapper.keyframes.between if images is None or view.keyframe in images]
    for view in views:
        if images is not None and view.index not in images:
            view.drop_image()
    copied = OnlineMapper(replace(mapper.config, device="cpu"), log, corrections, state, views, between, photometry)
    schedule = mapper.schedule.state()
    if len(copied.keyframes.trained) < len(mapper.keyframes.trained):
        schedule |= {"local": [], "all": []}  # positions have changed
    _restore(copied, schedule)
    copied.frame.origin, copied.frame.unit = mapper.frame.origin, mapper.frame.unit
    if splats is None:  # a part of the map gets no more splats
        copied.coarse.take(mapper.coarse.kept)
    copied.trainer.iterations, copied.trainer.rate = mapper.trainer.iterations, mapper.trainer.rate
    copied.trainer.generator.set_state(mapper.trainer.generator.get_state())
    return copied


def pack(
    mapper: OnlineMapper, prefix: str, images: list[str], between: list[str]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Of a mapper on the CPU: what goes into the state's JSON, and arrays whose names begin with the prefix.

    images: the file of each keyframe's image, empty where it was let go; between: of each frame between them.
    """
    frame = mapper.frame
    arrays = {f"{prefix}/splats/{name}": value.cpu().numpy() for name, value in mapper.state.tensors().items()}
    arrays |= columns(mapper.views, VIEWS, f"{prefix}/views/")
    arrays |= columns(mapper.keyframes.between, BETWEEN, f"{prefix}/between/")
    arrays |= {f"{prefix}/{name}": value for name, value in waiting_arrays(mapper.coarse.kept).items()}
    arrays[f"{prefix}/origin"] = np.zeros(0) if frame.origin is None else frame.origin
    arrays[f"{prefix}/generator"] = mapper.trainer.generator.get_state().numpy()
    meta = {
        "iterations": mapper.iterations, "unit": frame.unit, "rate": mapper.trainer.rate,
        "schedule": mapper.schedule.state(), "images": images, "between": between,
    }  # fmt: skip
    return meta, {name: np.ascontiguousarray(value) for name, value in arrays.items()}


def unpack(
    meta: Any, arrays: Arrays, config: MapperConfig, log: Stats, corrections: Corrections, photometry: ImageFormation,
    image: Callable[[str], tuple[torch.Tensor, torch.Tensor | None]],
) -> OnlineMapper:  # fmt: skip
    """The mapper that was packed. image: a keyframe's by its name, as `read_image`. Raises ValueError for damage.

    Images that do not stay in memory go to disk as they are read: a map may have more than there is room for.
    """
    if not isinstance(meta, dict):
        raise ValueError("a mapper's part is no object")
    device = torch.device(resolve_device(config.device))
    rows = keyframe_rows(arrays.of("views"), meta.get("images"))
    frames = keyframe_rows(arrays.of("between"), meta.get("between"), BETWEEN)
    left = meta.get("current") is False  # the stream has gone on in another map
    count = awake(config.images_in_memory, config.window) if not left else config.window
    made, held, room = dict[int, TrainingView](), 0, room_of(device)
    for row in sorted((*rows, *frames), key=lambda row: row["index"], reverse=True):
        view = made[id(row)] = _view(row, device, image, BetweenView if "keyframe" in row else TrainingView)
        count, held = count - view.has_image, held + bytes_of(view)
        if view.has_image and (count < 0 or held > room):
            rest(view, log)
        else:
            view.image, view.valid = view.image.to(device), None if view.valid is None else view.valid.to(device)
    views = [made[id(row)] for row in rows]
    between = [view for row in frames if isinstance(view := made[id(row)], BetweenView)]
    if not {view.keyframe for view in between} <= {view.index for view in views} or not all(
        b.has_image for b in between
    ):
        raise ValueError("frames between keyframes have no keyframe or no image")
    state = _splats(arrays.of("splats"), (config.sh_degree + 1) ** 2, [view.index for view in views], device)
    mapper = OnlineMapper(config, log, corrections, state, views, between, photometry)
    mapper.coarse.take(waiting_of(arrays, views))
    _restore(mapper, _object(meta.get("schedule")))
    mapper.trainer.iterations = whole(meta.get("iterations"), "iterations")
    mapper.trainer.rate = _positive(meta.get("rate"))
    mapper.frame.unit = None if meta.get("unit") is None else _positive(meta.get("unit"))
    origin = arrays.take("origin", np.float64, (None,))
    if len(origin) not in (0, 3) or (len(origin) == 0 and (views or mapper.frame.unit is not None)):
        raise ValueError("the origin is no position")
    mapper.frame.origin = origin.copy() if len(origin) else None
    if mapper.frame.unit is None and len(state):
        raise ValueError("there are splats, but no unit of length")
    try:
        mapper.trainer.generator.set_state(torch.from_numpy(arrays.take("generator", np.uint8, (None,)).copy()))
    except RuntimeError as error:
        raise ValueError(f"no state of a random generator: {error}") from error
    return mapper


def photometry_of(arrays: Arrays) -> ImageFormation:
    """What the tracker had said of the photographs. Raises ValueError for damage."""
    index = arrays.take("index", np.int64, (None,))
    exposures = arrays.take("exposure", np.float32, (len(index), 3, 4))
    vignetting = arrays.take("vignetting", np.float64, (None,))
    if len(vignetting) not in (0, 3) or (len(vignetting) and not is_vignetting(vignetting)):
        raise ValueError("the vignetting is none that a lens has")
    if not all(is_exposure(affine) for affine in exposures):
        raise ValueError("there are exposures that no camera has")
    found = {int(k): affine.copy() for k, affine in zip(index, exposures)}
    return ImageFormation(found, vignetting.copy() if len(vignetting) else None)


def photometry_arrays(photometry: ImageFormation) -> dict[str, np.ndarray]:
    """What `photometry_of` reads."""
    exposed = sorted(photometry.exposures)
    return {
        "index": np.array(exposed, dtype=np.int64),
        "exposure": np.array([photometry.exposures[k] for k in exposed], np.float32).reshape(-1, 3, 4),
        "vignetting": np.zeros(0) if photometry.vignetting is None else photometry.vignetting,
    }


def whole(value: Any, name: str) -> int:
    """A number of something. Raises ValueError for what is none."""
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{name} is {value!r}: expected a whole number of at least 0")
    return value


def _splats(arrays: Arrays, sh_bases: int, keyframes: list[int], device: torch.device) -> MapState:
    count = len(arrays.take("steps", np.int32, (None,)))
    rows = SPLATS | {"sh": (np.float32, (sh_bases, 3))}
    rows |= {f"{moment}/{name}": rows[name] for moment in ("first", "second") for name in PARAMETERS}
    found = {name: arrays.take(name, dtype, (count, *shape)) for name, (dtype, shape) in rows.items()}
    if count and not np.isin(found["anchors"], keyframes).all():
        raise ValueError("splats are anchored to keyframes that are not there")
    if (found["steps"] < 0).any() or any((found[f"second/{name}"] < 0).any() for name in PARAMETERS):
        raise ValueError("splats have ages or squares below 0")
    # copied to memory that torch aligned: with other vectors a sum may round otherwise
    return MapState.of({name: torch.from_numpy(value.copy()) for name, value in found.items()}, device)


def keyframe_rows(
    arrays: Arrays, images: Any, kept: dict[str, tuple[type, tuple[int, ...]]] = VIEWS
) -> list[dict[str, Any]]:
    """The values of each keyframe's TrainingView, and the `file` of its image. Raises ValueError for damage."""
    count = len(arrays.take("index", np.int64, (None,)))
    columns = {
        name: arrays.take(name, dtype, (count, *shape), nan=name in MAY_BE_NAN) for name, (dtype, shape) in kept.items()
    }
    sensible = all((columns[n] >= 0).all() for n in NEVER_BELOW_0)
    if not (sensible and (columns["image_size"] > 0).all() and (columns["scale"] > 0).all()):
        raise ValueError("keyframes have sizes, scales or counts that none has")
    if not (isinstance(images, list) and len(images) == count and all(isinstance(name, str) for name in images)):
        raise ValueError("not every keyframe's image is named")
    return [
        {name: v[k].copy() if v.ndim > 1 else v[k].item() for name, v in columns.items()} | {"file": file}
        for k, file in enumerate(images)
    ]


def _view(
    row: dict[str, Any], device: torch.device, image: Callable[[str], tuple[torch.Tensor, torch.Tensor | None]],
    kind: type[V],
) -> V:  # fmt: skip
    """With its image, which the row, kept by whoever has it, must not hold, on the CPU."""
    row = dict(row)
    row["image"], row["valid"] = image(row.pop("file"))
    row["image_size"] = tuple(row["image_size"].tolist())
    row["measured"] = None if np.isnan(row["measured"]).any() else row["measured"]
    row["surface"] = None if np.isnan(row.get("surface", np.nan)).any() else row["surface"]
    row["exposure"] = exposure_of(row["measured"], device)
    return kind(**row)


def _restore(mapper: OnlineMapper, schedule: dict[str, Any]) -> None:
    mapper.schedule.restore(schedule, len(mapper.keyframes.with_image), len(mapper.keyframes.trained))


def columns(
    views: Sequence[TrainingView], kept: dict[str, tuple[type, tuple[int, ...]]], prefix: str
) -> dict[str, np.ndarray]:
    """Each value of the views as an array, by its name after the prefix."""
    return {
        f"{prefix}{name}": np.array([_plain(getattr(view, name), shape) for view in views], dtype=dtype).reshape(
            -1, *shape
        )
        for name, (dtype, shape) in kept.items()
    }


def _copied(view: V) -> V:
    """On the CPU; images are shared, as they never change."""
    return replace(
        view, exposure=view.exposure.to("cpu", copy=True), pose_delta=view.pose_delta.copy(),
        pose_moments=view.pose_moments.copy(), velocity=view.velocity.copy(),
    )  # fmt: skip


def _plain(value: Any, shape: tuple[int, ...]) -> Any:
    """As numpy takes it; None is NaN."""
    return np.full(shape, np.nan) if value is None else value


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("an object is missing")
    return value


def _positive(value: Any) -> float:
    if type(value) is not float or not (math.isfinite(value) and value > 0):
        raise ValueError(f"{value!r} is no positive number")
    return value
