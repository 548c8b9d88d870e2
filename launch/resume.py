"""`resume=DIR`: the graph of an interrupted run, to go on in the same directory from its checkpoint.

Where the sources can be read again, the whole graph runs from the stream's beginning, and passes over what the map has.
Where they cannot (a live camera), or with dataset=resumed, the checkpoint's keyframes are the source, and what is left
is to refine and score.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import OverrideType
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError  # type: ignore[import-untyped]

import msgs
import nodes
from launch.compose import CONF, choice_of, defaults_of, graph_of, parse, prepare
from launch.graph import Graph, load_node
from launch.output import REPORT, read_report
from launch.refusal import GraphError
from launch.same_stream import check_stream
from launch.settings import BUFFER, FROM_SETTINGS, LIVE_BUFFER
from mvsgs_core.mapping.checkpoints.files import CheckpointInfo, checkpoint_info
from nodes.parameters import parameter_names

WORD = "resume="
SOURCE = "dataset"  # the slot of the choice that gives a checkpoint's keyframes
CHOICE = "resumed"


def resumed_config(folder: Path, overrides: Sequence[str], conf: Path = CONF) -> DictConfig:
    """What runs to go on with the run in `folder`, with overrides as on any command line.

    Raises GraphError where there is nothing to go on with, and where the frames would be others than the map's.
    """
    folder = folder.expanduser().absolute()
    config = _moved(_interrupted(folder), folder)
    info, before = _checkpoint(folder), _graph(config)
    slots = defaults_of(conf)
    for text in sorted(prepare(overrides, conf), key=_of_one_slot):
        _apply(config, text, slots, conf)
    alone = f"{SOURCE}={CHOICE}" in overrides
    if not alone:
        check_stream(before, _graph(config))
    if alone or not all(node.replayable for node in _classes(config).values() if nodes.is_source(node)):
        _without_stream(config, folder, conf)
    for slot, node in _classes(config).items():
        if not node.in_stream_order:
            raise GraphError(
                f"{WORD}{folder}: its {slot} sends keyframes in an order of its own, so that what the map lacks cannot "
                "be told from what it has; run it again from the start"
            )
        known = parameter_names(node.Config)
        if "resume" in known:
            config[slot].resume = str(folder)
        if "resume_after" in known:
            config[slot].resume_after = info.stereo_after()
    return config


def leave_out_refused(config: DictConfig) -> list[str]:
    """Turns off what only observes and cannot run again, such as a recorder whose file is there; says so.

    Raises GraphError for what no longer makes a graph, such as a parameter that this version does not have.
    """
    graph = _graph(config)
    notes = []
    for name in graph.observers:
        slot = graph.slots[name]
        if slot.placement.external:
            continue
        try:
            slot.node.check(slot.parameters)
        except (OSError, ValueError) as error:
            config[name] = {"_target_": None}
            notes.append(f"{name} is left out: {error}")
    return notes


def _graph(config: DictConfig) -> Graph:
    try:
        return graph_of(config, (), {})
    except GraphError as error:
        raise GraphError(f"{WORD}{config.output}: {error}") from error


def _interrupted(folder: Path) -> DictConfig:
    """The configuration of the run in that folder, which has not reached its end."""
    try:
        there = folder.is_dir()
    except OSError as error:  # no name of a directory
        raise GraphError(f"{WORD}{folder}: {error.strerror or error}") from error
    if not there:
        raise GraphError(f"{WORD}{folder}: no such directory; give the output directory of a run")
    file = folder / "config.yaml"
    try:
        config = OmegaConf.load(file)
    except FileNotFoundError:
        raise GraphError(f"{WORD}{folder}: no config.yaml there: it is not the output directory of a run") from None
    except (OSError, YAMLError, OmegaConfBaseException) as error:
        raise GraphError(f"{WORD}{folder}: {file} cannot be read: {error}") from error
    if not isinstance(config, DictConfig):
        raise GraphError(f"{WORD}{folder}: {file} is no configuration of a run")
    report = read_report(folder)
    if report.get("finished"):
        cut_off = "".join(f"; {text}: for all of it, run it again" for text in report.get("cut_off", {}).values())
        raise GraphError(
            f"{WORD}{folder}: that run has reached its end (see {folder / REPORT}): nothing is left to do{cut_off}"
        )
    return config


def _moved(config: DictConfig, folder: Path) -> DictConfig:
    """Where the run's directory has another name now: with that in every path that led into it, but to what stayed."""
    before = str(config.get("output") or folder)

    def moved(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: moved(item) for key, item in value.items()}
        if isinstance(value, list):
            return [moved(item) for item in value]
        if not isinstance(value, str) or not (value == before or value.startswith(f"{before}/")):
            return value
        there = f"{folder}{value[len(before) :]}"
        return value if Path(value).exists() and not Path(there).exists() else there

    found = OmegaConf.create(moved(OmegaConf.to_container(config)))
    assert isinstance(found, DictConfig)
    found.output = str(folder)
    return found


def _checkpoint(folder: Path) -> CheckpointInfo:
    try:
        return checkpoint_info(folder)
    except ValueError as error:
        raise GraphError(f"{WORD}{folder}: {error}") from error


def _apply(config: DictConfig, text: str, slots: Collection[str], conf: Path) -> None:
    """One override: another choice for a slot, or a value."""
    override = parse(text.lstrip("+"))
    if override.type is not OverrideType.CHANGE or override.is_sweep_override():
        raise GraphError(f"{text}: with {WORD}DIR only slot=choice and slot.parameter=value")
    key, value = override.key_or_group, override.value()
    if key in slots:
        config[key] = choice_of(key, str(value), conf)
    elif key == "output":
        raise GraphError(f"{text}: a run is resumed in its own directory")
    else:
        if key in (*FROM_SETTINGS, "device"):
            _release(config, key)
        OmegaConf.update(config, key, value, force_add=True)


def _of_one_slot(text: str) -> bool:
    """Such overrides come last, so that `mapper.seed=2 seed=1` means what it does in any command."""
    return "." in parse(text).key_or_group


def _release(config: DictConfig, key: str) -> None:
    """What slots have of a global key is left to that key: config.yaml holds what it was in the run that ended."""
    for slot, node in _classes(config).items():
        config[slot].pop(key, None)
        sent = config[slot].get("best_effort")
        if key == "realtime" and sent and not node.live:  # at the camera's pace a source of files sends so, too
            config[slot].best_effort = [name for name in sent if name != msgs.Frame.__name__]
    if key == "realtime" and config.get("buffer") in (BUFFER, LIVE_BUFFER):
        config.buffer = None


def _classes(config: DictConfig) -> dict[str, type[nodes.Node]]:
    """The node in each slot that has one."""
    targets = {
        str(slot): section.get("_target_") for slot, section in config.items() if isinstance(section, DictConfig)
    }
    return {slot: load_node(slot, str(target)) for slot, target in targets.items() if target is not None}


def _without_stream(config: DictConfig, folder: Path, conf: Path) -> None:
    """The checkpoint's keyframes in the sources' place; the stages up to the mapper are off."""
    config[SOURCE] = choice_of(SOURCE, CHOICE, conf)
    config[SOURCE].path = str(folder)
    classes = _classes(config)
    given = {message.__name__ for message in nodes.outputs(classes[SOURCE])}
    kept = {SOURCE}
    for slot, node in classes.items():
        section = config[slot]
        if "resume" in parameter_names(node.Config) or section.get("observer"):
            kept.add(slot)
    for slot in classes.keys() - {SOURCE}:
        reads: dict[str, Any] = dict(config[slot].get("reads") or {})
        gone = {name: sender for name, sender in reads.items() if sender.rstrip("?") not in kept - {SOURCE}}
        wanted = [name for name, sender in gone.items() if name in given or not sender.endswith("?")]
        if slot in kept and given >= set(wanted):
            config[slot].reads = reads | dict.fromkeys(wanted, SOURCE)
        else:
            config[slot] = {"_target_": None}
