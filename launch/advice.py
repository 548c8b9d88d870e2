"""What nodes advise of other slots (`Node.advise`), taken for those that neither command line nor configuration chose.

So a folder of photographs gets the tracker of photographs. It is said before anything runs, is in the run's command as
if it had been typed, and the node that was chosen says it in the report.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

from omegaconf import OmegaConf, open_dict

from launch.compose import CONF, choice_of, choices_of, defaults_of, graph_of, parse
from launch.graph import Graph
from launch.jobs import Job
from launch.refusal import GraphError
from nodes import Advice


def advised(job: Job, conf: Path = CONF) -> tuple[Job, list[str]]:
    """The job with what its nodes advise, and what is to be said of it. What cannot run is left to `run`, which says
    why."""
    notes: list[str] = []
    try:
        graph = graph_of(job.config, job.overrides, job.choices)
    except GraphError:
        return job, notes
    for slot, advice in _asked(graph).items():
        if not _unchosen(job, slot, conf) or advice.choice not in choices_of(slot, conf):
            continue
        if advice.choice == job.choices[slot]:
            notes.append(advice.why)
            continue
        taken = _with(job, slot, advice, conf)
        try:
            graph_of(taken.config, taken.overrides, taken.choices)
        except GraphError as error:
            notes.append(f"{advice.why}; {slot}={advice.choice} is not taken, for {error}")
            continue
        job = taken
        notes.append(f"{slot}={advice.choice}: {advice.why}")
    return job, notes


def _asked(graph: Graph) -> Mapping[str, Advice]:
    found: dict[str, Advice] = {}
    for slot in graph.slots.values():
        if not slot.placement.external:
            try:
                found |= slot.node.advise(slot.parameters)
            except (OSError, ValueError):
                continue  # the check before the run says it, and ends it
    return found


def _unchosen(job: Job, slot: str, conf: Path) -> bool:
    """Whether the slot is as config.yaml has it: nothing was said of it, not even a parameter."""
    if any(parse(text).key_or_group.partition(".")[0] == slot for text in job.overrides):
        return False
    default = defaults_of(conf).get(slot)
    if default is None or job.choices.get(slot) != default:
        return False
    return bool(job.config[slot] == choice_of(slot, default, conf))


def _with(job: Job, slot: str, advice: Advice, conf: Path) -> Job:
    config = deepcopy(job.config)
    with open_dict(config):
        config[slot] = OmegaConf.merge(choice_of(slot, advice.choice, conf), dict(advice.parameters))
    overrides = [*job.overrides, f"{slot}={advice.choice}"]
    return replace(job, config=config, overrides=overrides, choices={**job.choices, slot: advice.choice})
