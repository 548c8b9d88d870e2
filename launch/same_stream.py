"""A run is gone on with only on the frames that its map was made of: what may be another of its sources' settings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from launch.graph import Graph
from launch.refusal import GraphError
from launch.settings_file import FILES

MOST = 3  # changes that are named
FREE = ("realtime", "threads")  # how fast frames come, not which


def check_stream(before: Graph, after: Graph) -> None:
    """Raises GraphError where a source sends other frames than it did in the run that is gone on with.

    Files that were moved are found elsewhere: another path is taken where there is nothing at the one before.
    """
    for slot in before.sources:
        old, new = before.slots[slot], after.slots.get(slot)
        if new is None or new.target != old.target:
            source = "none" if new is None else new.target
            raise GraphError(f"{slot}={source} (was {old.target}): {_ADVICE}")
        if old.node.replayable:  # of another what came is in the checkpoint, and it is not asked again
            changes = islice(_changes(old.config, new.config), MOST)
            said = [f"{slot}.{name}={_said(value)} (was {_said(was)})" for name, was, value in changes]
            if said:
                raise GraphError(f"{', '.join(said)}: {_ADVICE}")


_ADVICE = "the map goes on with the frames that it was made of: leave that out, or begin another run with output=DIR"


def _changes(old: Mapping[str, Any], new: Mapping[str, Any], inside: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The parameters of which frames depend that have another value, with both values."""
    for name in {**old, **new}:
        was, value = old.get(name), new.get(name)
        if isinstance(was, Mapping) and isinstance(value, Mapping):
            yield from _changes(was, value, f"{inside}{name}.")
        elif was != value and not _same_frames(name, was, value):
            yield f"{inside}{name}", was, value


def _same_frames(name: str, was: Any, value: Any) -> bool:
    """Whether the frames that were read come as before."""
    if name == "stop":  # later: more come after them
        return was is not None and (value is None or value > was)
    if name in FILES and isinstance(was, str) and isinstance(value, str):
        return not Path(was).exists() or os.path.realpath(was) == os.path.realpath(value)
    return name in FREE


def _said(value: Any) -> Any:
    return "null" if value is None else value
