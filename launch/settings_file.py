"""config.yaml in a run's output: its command and all its parameters, from which `resume=DIR` goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch.graph import Graph

FILES = ("path", "mask", "gps")  # parameters of sources that name a file or folder


def lasting(graph: Graph) -> dict[str, Any]:
    """The configuration as it runs, with the sources' files where they are found from any directory."""
    found = dict(graph.resolved)
    for source in graph.sources:
        if graph.slots[source].node.replayable:
            found[source] = {key: _found(value) if key in FILES else value for key, value in found[source].items()}
    return found


def _found(value: Any) -> Any:
    there = isinstance(value, str) and value != "" and Path(value).exists()
    return str(Path(value).absolute()) if there else value
