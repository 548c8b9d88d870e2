"""The graph: which node stands in which slot, with which parameters, and who reads what from whom.

Built from the configuration and checked as a whole before any process starts. Knows no wiring of its own: slots,
choices and edges all come from `conf/`.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cached_property
from inspect import get_annotations
from pathlib import Path
from typing import Any

import msgs
import nodes
from launch.global_device import GlobalDevice
from launch.refusal import GraphError
from launch.requests import MESSAGES as REQUESTS
from launch.requests import asker
from launch.settings import BUFFER, FROM_SETTINGS, LIVE_BUFFER, Settings
from mvsgs_core.named_modules import import_named
from nodes.parameters import ParameterError, build, did_you_mean, parameter_names, plain_values

# A tracker that never corrects itself, poses keyframes alone or knows no path need not send these: readers work on what
# they have. Where some slot is their origin, an edge that misses them is an error all the same: corrections would be
# lost in silence.
OPTIONAL_MESSAGES = (msgs.Poses, msgs.TrackedFrame, msgs.CameraPose, msgs.TrackerPhase, msgs.Trajectory)


@dataclass(frozen=True)
class Placement:
    """Where and how a node runs: keys that every slot takes beside the node's own parameters."""

    cpu: list[int] | None = None  # cores to pin to
    threads: int | None = None  # None: a share of the cores, see launch/placement.py
    external: bool = False  # started by hand
    host: str | None = None  # tcp: where this slot's publishers are reached, if not at the global `host`
    # types that this slot sends newest-only, as a live camera does
    best_effort: list[str] = field(default_factory=list)
    observer: bool = False  # watches only: the run goes on without it


@dataclass(frozen=True)
class Edge:
    message: type
    sender: str
    reader: str
    best_effort: bool


@dataclass(frozen=True)
class Slot:
    """A node with its parameters, ready to run."""

    name: str
    node: type[nodes.Node]
    config: dict[str, Any]  # all of the node's parameters, plain JSON values
    reads: dict[type, str]  # message type -> sending slot, "?" after it for best effort
    placement: Placement

    @property
    def parameters(self) -> Any:
        """The node's Config."""
        return build(self.node.Config, self.config, self.name)

    @property
    def target(self) -> str:
        return f"{self.node.__module__}.{self.node.__qualname__}"


@dataclass(frozen=True)
class Graph:
    """Slots in an order in which every sender comes before its readers."""

    slots: dict[str, Slot]
    edges: list[Edge]
    settings: Settings
    resolved: dict[str, Any]  # the whole configuration as it runs, for config.yaml in the output directory
    warnings: list[str] = field(default_factory=list)

    def into(self, slot: str) -> list[Edge]:
        return [edge for edge in self.edges if edge.reader == slot]

    def out_of(self, slot: str) -> list[Edge]:
        return [edge for edge in self.edges if edge.sender == slot]

    @cached_property
    def observers(self) -> frozenset[str]:
        """Slots that nobody who makes the map depends on: declared so, or by their own choice newest-only readers."""
        found: set[str] = set()
        for name, slot in reversed(self.slots.items()):
            only_newest = bool(slot.reads) and all(sender.endswith("?") for sender in slot.reads.values())
            watched = all(edge.reader in found for edge in self.out_of(name))
            if slot.placement.observer or (only_newest and watched):
                found.add(name)
        return frozenset(found)

    @property
    def sources(self) -> list[str]:
        return [name for name, slot in self.slots.items() if nodes.is_source(slot.node)]


@dataclass(frozen=True)
class Replaced:
    """A slot whose `_target_` was given on the command line: what of the old choice's parameters still holds."""

    given: Collection[str]  # on the command line too: these hold
    interpolated: Collection[str]  # from a global key, such as ${output}: these hold where the new node has them


def build_graph(config: Mapping[str, Any], replaced: Mapping[str, Replaced] | None = None) -> Graph:
    """The checked graph of a resolved configuration. Raises GraphError, with what would be valid."""
    try:
        return _build_graph(config, replaced or {})
    except ParameterError as error:
        raise GraphError(str(error)) from error


def _build_graph(config: Mapping[str, Any], replaced: Mapping[str, Replaced]) -> Graph:
    settings, sections = _settings(config)
    settings = _paced(settings, sections)
    device = GlobalDevice(settings.device)
    slots: dict[str, Slot] = {}
    for name, section in sections.items():
        if section.get("_target_") is not None:
            slots[name] = _build_slot(name, section, replaced.get(name), settings, device)
    asking, unanswered = asker(
        {name: slot.reads for name, slot in slots.items()},
        {name: _outputs(name, slot.node) for name, slot in slots.items()},
    )
    if asking is None:
        slots = {name: _without_requests(slot) for name, slot in slots.items()}
    edges, warnings = connect(slots, list(sections))
    names = order(slots, edges)
    warnings += device.warnings
    warnings += unanswered
    for name in (name for name in sections if name not in slots):
        for key in sorted(sections[name].keys() - {"_target_"}):
            warnings.append(f"{name}.{key}: not used, as there is no {name}; --help lists what {name}= may be")
    if asking is not None:  # against the stream: nobody waits for a request
        edges += [Edge(msgs.Request, asking, name, False) for name in names if nodes.is_source(slots[name].node)]
    resolved: dict[str, Any] = plain_values(settings)
    resolved |= {name: _section(slots[name]) if name in slots else {"_target_": None} for name in sections}
    graph = Graph({name: slots[name] for name in names}, edges, settings, resolved, warnings)
    _check_observers(graph)
    _check_map(graph)
    return graph


def _settings(config: Mapping[str, Any]) -> tuple[Settings, dict[str, Mapping[str, Any]]]:
    """The keys that belong to no slot, and the slots' sections."""
    own = Settings.__dataclass_fields__
    sections = {key: value for key, value in config.items() if isinstance(value, Mapping) and key not in own}
    settings = build(Settings, {key: value for key, value in config.items() if key not in sections})
    supervise = settings.supervise
    if not 0.0 < supervise.silent < supervise.dead:
        raise GraphError(f"supervise.silent={supervise.silent:g}: must be above 0 and below dead={supervise.dead:g}")
    if settings.map is not None:
        read = Path(settings.map).expanduser().absolute()
        settings = replace(settings, map=str(read))
        written = None if settings.output is None else os.path.realpath(settings.output)
        if os.path.realpath(read) == written:  # by a link, too: the map would be moved aside
            raise GraphError(f"map={settings.map} is the output too: a new map is written, give another output=DIR")
    if settings.keep_map is None:
        settings = replace(settings, keep_map=settings.map is not None)
    return settings, sections


def _paced(settings: Settings, sections: Mapping[str, Mapping[str, Any]]) -> Settings:
    """With what depends on whether the camera waits for anybody."""
    targets = {name: section.get("_target_") for name, section in sections.items()}
    live = any(load_node(name, str(target)).live for name, target in targets.items() if target is not None)
    realtime = live if settings.realtime is None else settings.realtime
    buffer = (LIVE_BUFFER if realtime else BUFFER) if settings.buffer is None else settings.buffer
    return replace(settings, realtime=realtime, buffer=buffer)


def _build_slot(
    name: str, section: Mapping[str, Any], replaced: Replaced | None, settings: Settings, device: GlobalDevice
) -> Slot:
    node = load_node(name, str(section["_target_"]))
    _check_config(name, node)
    inputs, accepted = _handlers(name, node), parameter_names(node.Config)
    reads = dict(section.get("reads") or {})
    given = {key: value for key, value in section.items() if key not in ("_target_", "reads", "implies")}
    placement = {key: given.pop(key) for key in Placement.__dataclass_fields__ if key in given and key not in accepted}
    if replaced is not None:
        # The old choice's parameters are not this node's, even where names agree: its own defaults hold.
        kept = {*replaced.given, *(key for key in replaced.interpolated if key in accepted)}
        given = {key: value for key, value in given.items() if key in kept}
        reads = {key: value for key, value in reads.items() if key in {t.__name__ for t in inputs}}
    given = {key: getattr(settings, key) for key in FROM_SETTINGS if key in accepted} | given
    built = build(node.Config, given, name)
    parameters = plain_values(built) | _completed(name, node, built)
    typed: dict[type, str] = {}
    unused = node.unused_inputs(built)
    for message, sender in reads.items():
        if message not in msgs.TYPES:
            raise GraphError(f"{name}.reads.{message}: no such message; there are: {', '.join(msgs.TYPES)}")
        if not isinstance(sender, str):
            raise GraphError(f"{name}.reads.{message}={sender}: must be the name of the slot that sends it")
        if msgs.TYPES[message] not in unused:
            typed[msgs.TYPES[message]] = sender
    placed = build(Placement, placement, name)
    if parameters.get("device") == "auto":  # who is started elsewhere finds out there what there is
        parameters["device"] = device.wanted if placed.external else device.resolved
    if settings.realtime and nodes.is_source(node) and msgs.Frame.__name__ not in placed.best_effort:
        placed = replace(placed, best_effort=[*placed.best_effort, msgs.Frame.__name__])
    return Slot(name, node, parameters, typed, placed)


def _check_config(name: str, node: type[nodes.Node]) -> None:
    """Of a node that somebody else wrote. What inherits from a dataclass passes for one, without its own parameters."""
    config = node.Config
    if not is_dataclass(config) or (get_annotations(config) and "__dataclass_fields__" not in vars(config)):
        frozen = "(frozen=True)" if getattr(getattr(config, "__dataclass_params__", None), "frozen", False) else ""
        said = f"{node.__module__}.{node.__qualname__}.Config must be a dataclass: write @dataclass{frozen} above it"
        raise GraphError(f"{name}: {said}")


def _completed(name: str, node: type[nodes.Node], config: Any) -> dict[str, Any]:
    """The parameters that are mappings of known keys, with all of them."""
    try:
        known = node.keys_of(config)
    except ValueError as error:
        raise GraphError(f"{name}: {error}") from error
    completed = {}
    for parameter, keys in known.items():
        given, defaults = getattr(config, parameter), {key.name: key.default for key in keys}
        for key in given:
            if key not in defaults:
                raise GraphError(
                    f"{name}.{parameter}.{key}: there is no such key{did_you_mean(key, defaults)}; "
                    f"there are: {', '.join(defaults)}"
                )
        completed[parameter] = defaults | given
    return completed


def load_node(slot: str, target: str) -> type[nodes.Node]:
    """The node class `module.Class`. Raises GraphError where there is none."""
    module_name, _, class_name = target.rpartition(".")
    try:
        module = import_named(module_name)
    except ValueError:
        raise GraphError(f"{slot}._target_={target}: must be module.Class, as in nodes.tracker.Tracker") from None
    except ModuleNotFoundError as error:
        if error.name is not None and (module_name == error.name or module_name.startswith(error.name + ".")):
            raise GraphError(
                f"{slot}._target_={target}: no module {module_name!r} in the repository, the current directory "
                "or PYTHONPATH"
            ) from None
        raise GraphError(f"{slot}._target_={target}: importing {module_name} failed: {error}") from error
    except Exception as error:
        raise GraphError(f"{slot}._target_={target}: importing {module_name} failed: {error!r}") from error
    found = getattr(module, class_name, None)
    if isinstance(found, type) and issubclass(found, nodes.Node):
        return found
    there = [n for n, c in vars(module).items() if isinstance(c, type) and issubclass(c, nodes.Node)]
    there = [n for n in there if n != "Node"]
    what = "is no node (a subclass of nodes.Node)" if found is not None else "does not exist"
    raise GraphError(
        f"{slot}._target_={target}: {class_name} {what}; {module_name} has: {', '.join(there) or 'none'}"
        f"{did_you_mean(class_name, there)}"
    )


def connect(slots: Mapping[str, Slot], known: Collection[str]) -> tuple[list[Edge], list[str]]:
    """All edges, and warnings for optional ones that nobody feeds. Raises GraphError for a bad one."""
    sends = {name: _outputs(name, slot.node) for name, slot in slots.items()}
    takes = {name: _handlers(name, slot.node) for name, slot in slots.items()}
    edges: list[Edge] = []
    warnings: list[str] = []
    for name, slot in slots.items():
        inputs = takes[name]
        if nodes.is_source(slot.node) and (inputs or slot.reads):
            raise GraphError(f"{name}: {slot.target} is a source (it has run()), so it can read nothing")
        if not nodes.is_source(slot.node) and not inputs:
            raise GraphError(f"{name}: {slot.target} has neither run() nor an on_<message>(self, message: T)")
        for message in slot.reads:
            if message not in inputs:
                raise GraphError(
                    f"{name}.reads.{message.__name__}: {slot.target} does not take a {message.__name__}; "
                    f"it takes: {_names(inputs)}"
                )
        free = nodes.free_inputs(slot.node) | REQUESTS
        for message in [m for m in inputs if m in slot.reads or m not in free]:
            senders = ", ".join(other for other, types in sends.items() if message in types)
            hint = f"set {name}.reads.{message.__name__} to one that does: {senders}" if senders else "no slot does"
            if slot.placement.observer:
                hint += f"; {name}=off runs without it"
            refusal = f"{name}: nobody sends {slot.target} a {message.__name__}"
            if message not in slot.reads:
                raise GraphError(f"{refusal}: reads does not name the slot ({hint})")
            sender = slot.reads[message].removesuffix("?")
            if sender not in known:
                raise GraphError(
                    f"{name}.reads.{message.__name__}={sender}: no such slot{did_you_mean(sender, known)}; "
                    f"there are: {', '.join(known)}"
                )
            if message not in sends.get(sender, ()):
                why = (
                    f"{slots[sender].target} yields {_names(sends[sender])}" if sender in slots else "that slot is off"
                )
                origins = [other for other, types in sends.items() if message in types and message not in takes[other]]
                if not _spared(slot, message) and (message not in OPTIONAL_MESSAGES or origins):
                    raise GraphError(f"{refusal}: it reads it from {sender}, but {why} ({hint})")
                warnings.append(f"{name} gets no {message.__name__}: {sender}: {why}")
                continue
            best_effort = slot.reads[message].endswith("?")
            best_effort |= message.__name__ in slots[sender].placement.best_effort
            edges.append(Edge(message, sender, name, best_effort))
    return edges, warnings


def _spared(slot: Slot, message: type) -> bool:
    """Whether a slot works without a message: it would read the newest only, beside others that must all come."""
    must = [sender for sender in slot.reads.values() if not sender.endswith("?")]
    return bool(must) and slot.reads[message].endswith("?")


def order(slots: Collection[str], edges: Collection[Edge]) -> list[str]:
    """Slot names, every sender before its readers. Raises GraphError where edges go in a circle."""
    done: list[str] = []
    while len(done) < len(slots):
        left = [name for name in slots if name not in done]
        waits = {name: [e.sender for e in edges if e.reader == name and e.sender not in done] for name in left}
        if all(waits.values()):
            path = left[:1]
            while path[-1] not in path[:-1]:
                path.append(waits[path[-1]][0])
            loop = path[path.index(path[-1]) :][::-1]
            raise GraphError(f"a cycle: {' -> '.join(loop)}; a node cannot wait for what it causes itself")
        done += [name for name in left if not waits[name]]
    return done


def _check_observers(graph: Graph) -> None:
    """Nothing that makes the map may depend on an observer."""
    for edge in graph.edges:
        if edge.sender in graph.observers and edge.reader not in (*graph.observers, *graph.sources):
            raise GraphError(
                f"{edge.reader} reads {edge.message.__name__} from {edge.sender}, which may fail alone: set "
                f"{edge.sender}.observer=false, or {edge.reader}.observer=true"
            )


def _check_map(graph: Graph) -> None:
    """Who begins a map on another one, or keeps it, does so in all its parts: the poses', and the splats'."""
    asked = "map" if graph.settings.map is not None else "keep_map" if graph.settings.keep_map else None
    if asked is None:
        return
    for name, slot in graph.slots.items():
        sent = set(_outputs(name, slot.node))
        makes = msgs.SplatMap in sent or (msgs.Poses in sent and msgs.Poses not in slot.reads)
        if makes and asked not in slot.config:
            raise GraphError(f"{asked}: {slot.target} in {name} cannot; tracker=dense and mapper=ges can")


def _handlers(name: str, node: type[nodes.Node]) -> dict[type, str]:
    try:
        return nodes.handlers(node)
    except TypeError as error:
        raise GraphError(f"{name}: {error}") from error


def _without_requests(slot: Slot) -> Slot:
    """Where nobody asks anything."""
    return replace(slot, reads={message: sender for message, sender in slot.reads.items() if message not in REQUESTS})


def _outputs(name: str, node: type[nodes.Node]) -> tuple[type, ...]:
    """What it yields; a source's process sends requests on as well."""
    try:
        return (*nodes.outputs(node), msgs.Request) if nodes.is_source(node) else nodes.outputs(node)
    except TypeError as error:
        raise GraphError(f"{name}: {error}") from error


def _names(messages: Collection[type]) -> str:
    return ", ".join(message.__name__ for message in messages) or "nothing"


def _section(slot: Slot) -> dict[str, Any]:
    """A slot as its part of config.yaml."""
    placement = {key: value for key, value in vars(slot.placement).items() if value != getattr(Placement(), key)}
    reads = {message.__name__: sender for message, sender in slot.reads.items()}
    return {"_target_": slot.target, **({"reads": reads} if reads else {}), **placement, **slot.config}
