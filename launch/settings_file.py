"""config.yaml in a run's output: its command and all its parameters, from which `resume=DIR` goes on."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from launch.graph import Graph
from mvsgs_core.atomic_file import replacing
from mvsgs_core.passwords import without_passwords

FILES = ("path", "mask", "gps")  # parameters of sources that name a file or folder


def lasting(graph: Graph) -> dict[str, Any]:
    """The configuration as it runs, with the sources' files where they are found from any directory."""
    found = dict(graph.resolved)
    for source in graph.sources:
        if graph.slots[source].node.replayable:
            found[source] = {key: absolute(value) if key in FILES else value for key, value in found[source].items()}
    return found


def write_settings(file: Path, config: Mapping[str, Any], command: str) -> None:
    """Under the command that composed it. Only its owner may read a file with a camera's password. Raises OSError."""
    settings = OmegaConf.to_yaml(OmegaConf.create(dict(config)))
    secret = without_passwords(settings) != settings
    with replacing(file) as aside:
        aside.touch(0o600 if secret else 0o666)  # less what the user's mask takes away
        aside.write_text(f"# {without_passwords(' '.join(command.split()))}\n{settings}", encoding="utf-8")


def absolute(value: Any) -> Any:
    """The path of a file or folder that is there, as any directory finds it; else the value as it is."""
    there = isinstance(value, str) and value != "" and os.path.exists(value)  # noqa: PTH110  # raises nothing
    return str(Path(value).absolute()) if there else value
