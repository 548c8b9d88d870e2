"""A block's refinement as arrays and JSON: what a worker is given, what it makes of it, and how that is merged.

A job is the mapper itself, packed as for a checkpoint: the splats that the block owns, those that its keyframes see
beside them, and the images that it trains on. All keyframes are there, most without their image, so that the scene's
median depth is the same in every block. The splats that it does not own have no keyframe that the map knows: pruning
leaves them alone, and the result leaves them out. So each splat is in one result at most, whatever a block does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.array_file import Arrays
from mvsgs_core.mapping.blocks.parting import Parting, part
from mvsgs_core.mapping.checkpoints.images import image_of, pixels_of
from mvsgs_core.mapping.checkpoints.state import (
    BETWEEN,
    SPLATS,
    VIEWS,
    columns,
    copy_of,
    keyframe_rows,
    pack,
    photometry_arrays,
    photometry_of,
    unpack,
)
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats
from mvsgs_core.warned import Warnings

GRAY_LEVEL = 1.0 / 255.0  # of a pixel's light: what has less everywhere is not seen
NO_IMAGE = np.zeros((0, 0, 3), np.uint8)
NOBODY = -(2**63)  # anchor of a splat that another block owns
LEARNED = (  # what a keyframe's home says of it
    "pose_delta", "pose_moments", "pose_steps", "visits", "visits_here", "loss_fast", "loss_slow", "loss_before",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """What a block's worker is given."""

    meta: dict[str, Any]  # as JSON has it
    arrays: dict[str, np.ndarray]
    images: dict[str, np.ndarray]  # (H, W, 3) uint8, or with the valid pixels as alpha (H, W, 4), by name


@dataclass(frozen=True)
class Result:
    """What it made of it: the splats that the block owns, the keyframes at home there."""

    arrays: dict[str, np.ndarray]
    iterations: int
    rate: float  # of learning, at the end
    logged: dict[str, Any]  # of the worker's Stats, by name


def parting_of(mapper: OnlineMapper, blocks: int) -> Parting:
    """The mapper's splats and keyframes, in at most so many blocks."""
    splats = mapper.state.detached()
    means, log_scales = splats.means.cpu().numpy(), splats.log_scales.cpu().numpy()
    opacity = torch.sigmoid(splats.opacity_logits).cpu().numpy()
    overlap = mapper.config.refine.overlap
    views = mapper.views
    between: dict[int, list[TrainingView]] = {}
    for frame in mapper.keyframes.between:
        between.setdefault(frame.keyframe, []).append(mapper.chosen(frame))

    def shown(k: int) -> np.ndarray:
        found = np.zeros(len(mapper.state), bool)
        for view in [views[k]] if views[k].has_image else between.get(views[k].index, []):
            found |= (mapper.trainer.weights(view, mapper.median_depth) >= GRAY_LEVEL).cpu().numpy()
        return found

    shared = np.array([view.index in between for view in views], bool)
    return part(views, means, log_scales, opacity, mapper.median_depth, blocks, overlap, shown, shared)


def iterations_of(mapper: OnlineMapper, parting: Parting, total: int) -> list[int]:
    """Of each block, when the whole map would get `total`: an image has as many in every block that trains on it as it
    would have there. With fewer where it is a guest, the splats that it sees would be left half refined."""
    between = Counter(frame.keyframe for frame in mapper.keyframes.between)
    images = np.array([view.has_image + between[view.index] for view in mapper.views])
    parts: list[int] = np.round(total * (parting.trained @ images) / max(1, images.sum())).astype(int).tolist()
    return parts


def job_of(mapper: OnlineMapper, parting: Parting, block: int, iterations: int, last: int = 0) -> Job:
    """The block's part of the mapper, which goes on as it is. last: of the iterations, those that are not its own."""
    trained = {view.index for view, here in zip(mapper.views, parting.trained[block]) if here}
    home = [view.index for view, at in zip(mapper.views, parting.home) if at == block]
    for frame in mapper.keyframes.between:
        mapper.chosen(frame)  # stands where its keyframe does
    rows = torch.from_numpy(parting.needed[block])
    copied = copy_of(mapper, Stats(), {}, mapper.photometry.copy(), splats=rows, images=trained)
    images: dict[str, np.ndarray] = {}
    names = [_take(view, images) for view in copied.views], [_take(view, images) for view in copied.keyframes.between]
    meta, arrays = pack(copied, "map", *names)
    at_home = len(trained.intersection(home)) / max(1, len(trained))
    arrays |= {f"photometry/{name}": value for name, value in photometry_arrays(copied.photometry).items()}
    arrays["owned"] = (parting.owner == block)[parting.needed[block]]
    told = {"mapper": meta, "refinement": iterations, "last": last, "home": home, "at_home": at_home}
    return Job(told, arrays, images)


def refined(job: Job, config: MapperConfig) -> Iterator[Result | None]:
    """Refines a block with the ordinary trainer: None after each iteration, the result last.

    config: of the mapper, with the device and the threads to use here. Raises ValueError for a job that is damaged.
    """
    arrays, log = Arrays(job.arrays), Stats()
    photometry = photometry_of(arrays.of("photometry"))
    control = config.density_control  # what may be lost of a guest's image is its home's
    config = replace(config, density_control=replace(control, needless=control.needless * job.meta["at_home"]))

    def image(name: str) -> tuple[Tensor, Tensor | None]:
        return image_of(job.images[name] if name else NO_IMAGE)

    mapper = unpack(job.meta["mapper"], arrays.of("map"), config, log, {}, photometry, image)
    home, state = set(job.meta["home"]), mapper.state
    owned = torch.from_numpy(arrays.take("owned", np.bool_, (len(state),)).copy()).to(state.device)
    state.anchors = torch.where(owned, state.anchors, NOBODY)
    fixed = {view.index for view in mapper.views if view.fixed}
    for view in mapper.views:
        view.fixed = view.fixed or view.index not in home  # a pose is refined at home
    total, before = job.meta["refinement"], mapper.iterations
    for done in range(total - job.meta["last"]):
        mapper.refine(done, total)
        yield None
    state.keep(state.anchors != NOBODY)
    learned = [view for view in mapper.views if view.index in home]
    for view in learned:
        view.fixed = view.index in fixed
    between = [frame for frame in mapper.keyframes.between if frame.keyframe in home]
    found = {f"splats/{name}": value.cpu().numpy() for name, value in state.tensors().items()}
    found |= columns(learned, VIEWS, "views/") | columns(between, BETWEEN, "between/")
    logged = {"counts": log.counts, "seconds": log.seconds, "skipped": log.skipped, "warnings": list(log.warnings)}
    yield Result(found, mapper.iterations - before, mapper.trainer.rate, logged)


def merge(mapper: OnlineMapper, results: Sequence[Result]) -> None:
    """Takes over what the blocks made of their parts. Raises ValueError, before anything is changed, for a result that
    is damaged."""
    tensors = [_splats(Arrays(result.arrays).of("splats"), mapper) for result in results]
    rows = [
        row
        for result in results
        for kind, kept in (("views", VIEWS), ("between", BETWEEN))
        for row in keyframe_rows(Arrays(result.arrays).of(kind), [""] * len(result.arrays[f"{kind}/index"]), kept)
    ]
    known = {view.index: view for view in (*mapper.views, *mapper.keyframes.between)}  # with and without an image
    if strange := [row["index"] for row in rows if row["index"] not in known]:
        raise ValueError(f"a block's result names frame {strange[0]}, which the map does not have")
    mapper.state.become({name: torch.cat([part[name] for part in tensors]) for name in tensors[0]})
    for row in rows:
        for name in LEARNED:
            setattr(known[row["index"]], name, row[name])
    mapper.keyframes.owed.count(mapper.keyframes.with_image)
    mapper.trainer.rate = min(result.rate for result in results)
    for result in results:
        mapper.trainer.iterations += result.iterations
        mapper.log.add(Stats(**result.logged | {"warnings": Warnings(result.logged["warnings"])}))


def plain(config: MapperConfig) -> MapperConfig:
    """Without what a node has beside it, of which a worker needs to know nothing."""
    return MapperConfig(**{entry.name: getattr(config, entry.name) for entry in fields(MapperConfig)})


def _splats(arrays: Arrays, mapper: OnlineMapper) -> dict[str, Tensor]:
    state, kept = mapper.state, mapper.state.tensors()
    count = len(arrays.take("steps", SPLATS["steps"][0], (None,)))
    found = {}
    for name, value in kept.items():
        dtype = value.cpu().numpy().dtype.type
        found[name] = torch.from_numpy(arrays.take(name, dtype, (count, *value.shape[1:])).copy()).to(state.device)
    return found


def _take(view: TrainingView, images: dict[str, np.ndarray]) -> str:
    """The name of its image, which is put among `images`; empty where it has none."""
    if not view.has_image:
        return ""
    name = f"{view.index}"
    images[name] = pixels_of(view)
    return name
