"""Names that parameters had once: refused, with the name to write instead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args, get_origin, get_type_hints

from launch.refusal import GraphError
from nodes.parameters import nested_in

RENAMED: tuple[tuple[str, str], ...] = (  # what it was, what it is with a node that takes it
    ("tracker.keyframe_flow", "tracker.keyframe_choice.max_flow"),
    ("tracker.keyframe_share", "tracker.keyframe_choice.min_fraction"),
    ("tracker.still_flow", "tracker.front_end.still_flow"),
    ("tracker.start_keyframes", "tracker.initialization.min_keyframes"),
    ("tracker.window", "tracker.local_map.window"),
    ("tracker.recent", "tracker.local_map.recent"),
    ("tracker.proximity", "tracker.local_map.proximity"),
    ("tracker.steps", "tracker.local_map.steps"),
    ("tracker.global_edges", "tracker.back_end.max_edges"),
    ("tracker.known_flow", "tracker.covisibility.max_flow"),
    ("tracker.known_from", "tracker.covisibility.min_keyframes"),
    ("tracker.readout", "tracker.readout_time"),
    ("tracker.unroll", "tracker.rectify_rolling_shutter"),
    ("mvs.neighbors", "mvs.neighbors.count"),
    ("mvs.best_views", "mvs.cost.top_k"),
    ("mvs.paths", "mvs.smoothing.paths"),
    ("mvs.range_margin", "mvs.ranges.margin"),
    ("mvs.stages.small_jump", "mvs.stages.p1"),  # of each in the list
    ("mvs.stages.large_jump", "mvs.stages.p2"),
    ("mvs.least_cells", "mvs.ranges.min_cells"),
    ("mvs.skip_cells", "mvs.pruning.outside_cells"),
    ("depth_fusion.least_views", "depth_fusion.min_views"),
    ("mapper.density", "mapper.training.kernel"),
    ("mapper.betas", "mapper.training.betas"),
    ("mapper.loss", "mapper.training.loss"),
    ("mapper.exposure", "mapper.training.exposure"),
    ("mapper.refine_poses", "mapper.training.refine_poses"),
    ("mapper.selective", "mapper.training.selective"),
    ("mapper.skip_converged", "mapper.convergence.skip"),
    ("mapper.unexplored", "mapper.insertion.unexplored"),
    ("mapper.insertion.unexplored_opacity", "mapper.insertion.min_opacity"),
    ("mapper.density_control", "mapper.density_control.mode"),
    ("mapper.keep_checkpoint", "mapper.keep_map"),
    ("mapper.max_splats", "mapper.density_control.max_splats"),
    ("tracker.stride", "tracker.constants.stride"),
    ("tracker.filter_threshold", "tracker.constants.filter_threshold"),
    ("tracker.keyframe_threshold", "tracker.constants.keyframe_threshold"),
    ("tracker.warmup", "tracker.constants.warmup"),
    ("tracker.window", "tracker.constants.frontend_window"),
    ("tracker.backend_every", "tracker.constants.backend_every"),
)
PRICE = "how many splats an image gets is mapper.insertion.price now: a lower one gives more splats"
GONE: Mapping[str, str] = {
    "mapper.coarse_to_fine": "it gained nothing that could be measured",
    "mapper.skip_tiles": "it gained nothing that could be measured",
    "mapper.map_views": "it was for mvs=skipping",
    "mapper.insertion.min_confidence": "depth comes filtered already",
    "mapper.training.frequency_horizon": "the frequency goes through the whole training, however long it is",
    "mapper.training.exposure_rate": "exposures are the tracker's: training them further gained nothing",
    **{
        f"{path}.{name}": why
        for path in ("mapper", "mapper.insertion")
        for name, why in {
            "unexplored_psnr": PRICE,
            "voxel": PRICE,
            "map_voxel": "write mapper.insertion.median_errors=0 for a splat wherever it saves its price",
            "map_voxel_error": "it is mapper.insertion.median_errors now, of every pixel that the map shows",
            "fill": "write mapper.insertion.doubtful=false where holes are to stay, and else nothing",
        }.items()
    },
    **dict.fromkeys(
        (f"mapper.insertion.{name}" for name in ("fill_below", "fill_opacity", "fill_scale")),
        "splats of doubtful depth begin as all others: min_opacity, initial_opacity, initial_scale",
    ),
    "mapper.density_control.prune_scale": "no splat grows beyond mapper.optimizer.max_scale",
    **dict.fromkeys(
        (f"depth_fusion.{name}" for name in ("rim", "discontinuity_radius", "speckle")),
        "the confidence knows edges and small patches: with a higher depth_fusion.confidence less of them is kept",
    ),
    "mvs.skip_certain": "it cost precision and saved no time",
    "mvs.skip_explained": "it passed over no keyframe of a camera's stream",
    "mvs.tolerance": "it was of mvs=skipping",
}


def refuse_old_names(slot: str, config: type, given: Mapping[str, Any]) -> None:
    """Raises GraphError for those of a slot's parameters that have another name now, or are gone."""

    def old_name(name: str) -> bool:
        path = _path(slot, name)
        return path is not None and _given(given, path) and not _takes(config, path)

    found = [f"{old} is {new} now" for old, new in RENAMED if old_name(old) and _takes(config, _path(slot, new) or [])]
    found += [f"{old} is gone: {why}" for old, why in GONE.items() if old_name(old)]
    if found:
        raise GraphError("; ".join(found))


def _path(slot: str, name: str) -> list[str] | None:
    """The keys within a slot; None for a name of another slot."""
    first, *path = name.split(".")
    return path if first == slot else None


def _given(values: Any, path: list[str]) -> bool:
    """Whether a value stands there; a mapping is none, as a parameter of that name may have become a group."""
    for place, key in enumerate(path):
        if isinstance(values, list):
            return any(_given(value, path[place:]) for value in values)
        if not isinstance(values, Mapping) or key not in values:
            return False
        values = values[key]
    return not isinstance(values, Mapping)


def _listed_in(annotation: Any) -> type | None:
    """The dataclass of which a parameter lists any number."""
    members = get_args(annotation)
    return nested_in(members[0]) if get_origin(annotation) is tuple and members[1:] == (...,) else None


def _takes(config: Any, path: list[str]) -> bool:
    """Whether the node's dataclass has that parameter, or a mapping that may hold it."""
    for key in path:
        hints = get_type_hints(config)
        if key not in hints:
            return False
        config = nested_in(hints[key]) or _listed_in(hints[key])
        if config is None:
            return key == path[-1] or get_origin(hints[key]) is dict
    return False
