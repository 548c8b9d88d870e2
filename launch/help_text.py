"""`mvsgs --help ...`: slots, choices and every parameter of what a command line composes, read from the source.

Type, default and the comment beside the field stand in the dataclass alone; the first lines of a choice's file say what
the choice is.
"""

from __future__ import annotations

import json
import shutil
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, replace
from pathlib import Path
from typing import Any

from launch.field_comments import field_comments
from launch.graph import Graph, Placement, Slot
from launch.settings import Settings
from nodes.parameters import Parameter, parameters, plain_values, type_name

HEADER = """\
Maps a video, a photo sequence or a live camera with Gaussian splats.

  mvsgs demo                                   the synthetic room
  mvsgs walk.mp4                               a video, a folder of images, a data set, by what it is
  mvsgs dataset=tum dataset.path=DIR           a TUM RGB-D sequence
  mvsgs camera viewer=viser                    a camera, live; Ctrl-C ends the stream, not the map
  mvsgs resume=DIR                             goes on with an interrupted run, in its directory
  mvsgs dataset=camera map=DIR                 goes on in the map of a run with keep_map=true
  mvsgs dataset=camera map=DIR mapper=frozen   only finds the camera in it
  mvsgs -m mapper.iterations=100,300           a sweep
  mvsgs -m hydra/launcher=submitit_slurm mapper.iterations=100,300    the same on a Slurm cluster
  mvsgs refine=ray refine.address=HOST:6379    refines the map on a Ray cluster's machines
  mvsgs --inline                               everything in one process, for a debugger
  mvsgs --graph mapper=paper                   shows the graph of any command line, and runs nothing
  mvsgs --help mapper=paper                    this, for what that command line composes
  mvsgs tracker._target_=my_tracker.Mine       a node of your own, from a file in this directory
  mvsgs tracker=external                       prints how to run that node by hand, elsewhere

In a checkout `python launch/run_all.py ...` is the same as `mvsgs run ...`.
"""
EDGES = 'Edges: <slot>.reads.<Message>=<slot that sends it>; with "?" after it: newest only, never slows the sender.'
COMMENT_COLUMN = 44
MIN_WIDTH, MAX_WIDTH = 100, 140


def help_text(graph: Graph, choices: Mapping[str, Any], folders: Sequence[Path]) -> str:
    """The whole text. `choices`: the choice of each slot; `folders`: where the choices' files are."""
    slots = [name for name in graph.resolved if name not in Settings.__dataclass_fields__]
    there = {
        slot: sorted({path.stem for folder in folders for path in (folder / slot).glob("*.yaml")}) for slot in slots
    }
    lines = [HEADER, "== Slots and their choices: slot=choice ==", ""]
    for where, names in there.items():
        lines += textwrap.wrap(f"{where}: {', '.join(names)}", _width(), subsequent_indent="    ")
    lines += ["", "== What this command line gives: slot.parameter=value =="]
    for name, slot in graph.slots.items():
        choice = choices.get(name)
        lines += ["", f"{name}={choice}: {slot.target}", *_about(folders, name, choice), *_of_node(slot)]
    lines += ["", "== Keys of no slot: key=value ==", "", *_of(parameters(Settings), "", plain_values(graph.settings))]
    lines += ["", "== What every slot takes besides: slot.key=value ==", ""]
    lines += [*_of(parameters(Placement, "slot"), "slot", {}), "", EDGES]
    return "\n".join(lines)


def _about(folders: Sequence[Path], slot: str, choice: Any) -> Iterator[str]:
    """The comment at the head of a choice's file."""
    for file in (folder / slot / f"{choice}.yaml" for folder in folders):
        if file.exists():
            for line in file.read_text().splitlines():
                if not line.startswith("#"):
                    return
                yield "  " + line.lstrip("# ")


def _of_node(slot: Slot) -> Iterator[str]:
    declared = list(parameters(slot.node.Config, slot.name))
    for mapping, keys in slot.node.keys_of(slot.parameters).items():
        at = next(i for i, parameter in enumerate(declared) if parameter.name == mapping)
        declared[at : at + 1] = [replace(key, path=f"{slot.name}.{mapping}.{key.name}") for key in keys]
    yield from _of(declared, slot.name, slot.config)


def _of(declared: Iterable[Parameter], where: str, values: Mapping[str, Any]) -> Iterator[str]:
    """A line for each parameter: path and value, type, comment, and the default where the value is another."""
    for parameter in declared:
        path, default = parameter.path, parameter.default
        value = _at(values, path.removeprefix(f"{where}."), default)
        what = [type_name(parameter.annotation), field_comments(parameter.owner).get(parameter.name, "")]
        if default is not MISSING and value != default:
            what.append(f"(default: {_text(default)})")
        yield from _columns(f"{path}={_text(value)}", "; ".join(filter(None, what)))


def _at(values: Any, path: str, default: Any) -> Any:
    for key in path.split("."):
        if key not in values:
            return default
        values = values[key]
    return values


def _columns(left: str, right: str) -> list[str]:
    left = f"  {left}"
    wrapped = textwrap.wrap(right, _width() - COMMENT_COLUMN) or [""]
    rest = [" " * COMMENT_COLUMN + line for line in wrapped]
    if len(left) < COMMENT_COLUMN:
        return [f"{left:{COMMENT_COLUMN}}{wrapped[0]}".rstrip(), *rest[1:]]
    return [*textwrap.wrap(left, _width(), subsequent_indent="    "), *rest]


def _width() -> int:
    return min(max(shutil.get_terminal_size((MAX_WIDTH, 24)).columns, MIN_WIDTH), MAX_WIDTH)


def _text(value: Any) -> str:
    """As it is written on a command line."""
    return value if isinstance(value, str) and value else json.dumps(value)
