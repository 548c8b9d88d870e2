"""What a node's process is told: a JSON file with its class, parameters, topics and placement.

    {"name": "mvs", "target": "nodes.mvs.Mvs", "config": {...},
     "inputs": [{"type": "Keyframe", "slot": "tracker", "address": "ipc:///tmp/x/tracker.Keyframe",
                 "best_effort": false, "away": 0.0}],
     "outputs": [{"type": "Depth", "address": "ipc:///tmp/x/mvs.Depth", "readers": 1, "observers": [], "patience": 0.0,
                  "away": 0.0, "live": false}],
     "observer": false, "returns": false, "buffer": 4, "dead": 60.0, "seed": 0, "threads": 1, "cpu": null, "nice": 0,
     "keys": null, "token": "", "status_fd": null}

`readers` counts those of both kinds without observers, which are named; `buffer` is in messages; `keys` is a folder,
see `addresses.load_keys`; `token` is a secret of the run, without which a publisher takes nobody for a reader. A
file NAME.gone beside this one says that the observer NAME is gone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgs
from nodes.parameters import ParameterError, build


@dataclass(frozen=True)
class Input:
    type: str
    slot: str  # that sends it
    address: str
    best_effort: bool = False
    away: float = 0.0  # s for which its sender is waited for, once it is lost; 0: that is an error at once

    @property
    def topic(self) -> str:
        return f"{self.slot}.{self.type}"


@dataclass(frozen=True)
class Output:
    type: str
    address: str
    readers: int
    observers: tuple[str, ...] = ()
    patience: float = 0.0  # s for which these are waited for once all others are there; 0: until they are gone
    away: float = 0.0  # s for which a reader is waited for, once it is lost
    live: bool = False  # the newest is all that anybody reads, over a link that may be slower: few old ones may wait


@dataclass(frozen=True)
class Spec:
    name: str
    target: str  # module.Class
    config: Mapping[str, Any]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    observer: bool = False  # nobody who makes the map depends on this node
    returns: bool = False  # it may be started again in the midst of a run
    buffer: int = 4  # messages
    dead: float = 60.0  # s for which a reader of the newest only may take to read the last message
    seed: int = 0
    threads: int | None = None  # None: all cores of this host
    cpu: tuple[int, ...] | None = None  # cores; None: all
    nice: int = 0  # by how much it gives way to other processes
    keys: str | None = None
    token: str = ""
    status_fd: int | None = None
    folder: Path | None = None  # of the file it was read from

    @staticmethod
    def read(path: Path) -> Spec:
        """Raises ValueError, OSError for a file that is no specification."""
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise ValueError(f"{path}: must be a JSON object")
        try:
            spec = build(Spec, content)
        except ParameterError as error:
            raise ValueError(f"{path}: {error}") from error
        for kind in [given.type for given in spec.inputs] + [given.type for given in spec.outputs]:
            if kind not in msgs.TYPES:
                raise ValueError(f"{path}: {kind} is no message; the types are {', '.join(msgs.TYPES)}")
        return replace(spec, folder=path.parent)

    def kept_in(self) -> Path | None:
        """Beside the file, a folder for what a process needs that is started again; emptied for another run."""
        if not self.returns or self.folder is None:
            return None
        kept, own = self.folder / f"{self.name}.kept", self.folder / f"{self.name}.json"
        if kept.exists() and own.exists() and kept.stat().st_mtime < own.stat().st_mtime:
            shutil.rmtree(kept)
        return kept

    def awaited_observers(self, output: Output) -> list[str]:
        """The observers of an output that are not known to be gone."""
        return [name for name in output.observers if self.folder is None or not gone_file(self.folder, name).exists()]


def gone_file(folder: Path, name: str) -> Path:
    return folder / f"{name}.gone"
