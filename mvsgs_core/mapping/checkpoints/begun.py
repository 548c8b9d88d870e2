"""The map that another run left, as this run's stream goes on in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mvsgs_core.kept_map import STREAM
from mvsgs_core.mapping.atlas import Atlas
from mvsgs_core.mapping.checkpoints.checkpoint import load
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import TrainingView
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.stats import Stats


def begin_on(output: Path, config: MapperConfig, log: Stats) -> Atlas:
    """The atlas of a run's output, before the first frame of a new stream.

    Its keyframes are numbered below 0, see `kept_map`; what they are now has scale 1, as the tracker says then. No
    iteration is pending; keyframes that wait for their splats wait on. Raises ValueError where there is none, or
    `config` does not fit.
    """
    loaded, _ = load(output, config, log, counted=False)
    parts = {segment: _begun(part, log) for segment, part in loaded.parts.items()}
    current = next(parts[segment] for segment, part in loaded.parts.items() if part is loaded.current)
    poses = {view.index: (view.world_from_cam, view.scale) for part in parts.values() for view in part.views}
    current.corrections.clear()
    current.corrections |= poses
    exposures = current.photometry.exposures
    moved = {index - STREAM: affine for index, affine in exposures.items()}
    exposures.clear()
    exposures |= moved
    segment_of = {view.index: segment for segment, part in parts.items() for view in part.views}
    return Atlas(current, parts, segment_of)


def _begun(part: OnlineMapper, log: Stats) -> OnlineMapper:
    """The same part, renumbered; its corrections and photometry stay those that all parts share."""
    scales = {view.index: view.scale for view in part.views}
    for view in part.views:
        _renumber(view, view.scale)
    between = part.keyframes.between
    for frame in between:
        _renumber(frame, scales[frame.keyframe])
        frame.keyframe -= STREAM
    waiting = [
        replace(kept, keyframe=replace(k, index=k.index - STREAM, scale=k.scale / scales[k.index]))
        for kept in part.coarse.kept
        for k in [kept.keyframe]
    ]
    part.state.anchors -= STREAM
    part.schedule.drop()
    found = OnlineMapper(part.config, log, part.corrections, part.state, part.views, between, part.photometry)
    found.frame.origin, found.frame.unit = part.frame.origin, part.frame.unit
    found.coarse.take(waiting)
    found.trainer.iterations = part.trainer.iterations
    return found


def _renumber(view: TrainingView, scale: float) -> None:
    """scale: of its keyframe, which is 1 from here on."""
    view.index -= STREAM
    view.scale /= scale
    view.loss_before = float("nan")


__all__ = ["begin_on"]
