"""One run from its composed configuration: graph, processes or one process, summary, exit code."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import nodes
from launch.compose import graph_of
from launch.graph import Graph
from launch.inline import run_inline
from launch.parameters import GraphError
from launch.screen import Screen, make_screen
from launch.status import NodeStatus
from launch.summary import summary
from launch.supervise import Outcome, Supervisor
from nodes.parameters import make_config


class RunFailed(RuntimeError):
    """A job of a sweep failed: the sweep goes on, and ends with a non-zero exit code."""


@dataclass(frozen=True)
class Job:
    """What Hydra hands over."""

    config: DictConfig
    overrides: Sequence[str]
    choices: dict[str, Any]
    number: int | None  # in a sweep

    @staticmethod
    def of(config: DictConfig, hydra: Any) -> Job:
        sweep = hydra.mode == RunMode.MULTIRUN
        if sweep:
            config.output = hydra.runtime.output_dir
        return Job(config, list(hydra.overrides.task), dict(hydra.runtime.choices), hydra.job.num if sweep else None)


def run(job: Job) -> int:
    """Runs one job and returns its exit code. In a sweep a failure is raised instead: RunFailed, after which the sweep
    goes on, or SystemExit where the user stopped it."""
    if job.number is not None:
        print(f"job {job.number}: {' '.join(text.lstrip('+') for text in job.overrides)}", flush=True)
    code = _run(job)
    if job.number is not None and code:
        if code > 128:
            raise SystemExit(code)
        raise RunFailed(f"job {job.number} ended with code {code}")
    return code


def _run(job: Job) -> int:
    try:
        graph = graph_of(job.config, job.overrides, job.choices)
        _check_nodes(graph)
        output = _prepare_output(graph)
        screen = make_screen(graph.settings.screen)
        began = time.time()
        if graph.settings.inline:
            _run_inline(graph, screen)
            outcome = Outcome(0)
        else:
            outcome = Supervisor(graph, screen).run()
    except GraphError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if outcome.failed is None and outcome.code == 0:
        screen.note(summary(output, newer_than=began))
    elif outcome.failed is None:
        screen.note("stopped")
    else:
        _report_failure(outcome)
    return outcome.code


def _check_nodes(graph: Graph) -> None:
    """What nodes that run here already know they lack. Raises GraphError."""
    for name, slot in graph.slots.items():
        if slot.placement.external:
            continue
        _check_device(name, slot.config.get("device"))
        try:
            slot.node.check(make_config(slot.node, slot.config))
        except (OSError, ValueError) as error:
            raise GraphError(f"{name}: {error}") from error


def _check_device(slot: str, device: Any) -> None:
    """A GPU that a slot asks for by itself, not by the global `device`, must be there."""
    if not isinstance(device, str) or not device.startswith("cuda"):
        return
    import torch  # takes a second to load

    there, number = torch.cuda.device_count(), device.partition(":")[2] or "0"
    if not number.isdigit() or int(number) >= there:
        raise GraphError(f"{slot}.device={device}: this machine has {there} CUDA devices; use {slot}.device=cpu")


def _prepare_output(graph: Graph) -> Path:
    """Creates the output directory with the configuration as it runs."""
    output = Path(graph.settings.output)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GraphError(f"output={output}: {error.strerror}") from error
    (output / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(graph.resolved)))
    return output


def _run_inline(graph: Graph, screen: Screen) -> None:
    statuses = {name: NodeStatus(name, "running") for name in graph.slots}
    screen.start(graph, statuses, {})

    def observe(slot: str, node: nodes.Node, message: Any) -> None:
        status = statuses[slot]
        status.sent[type(message).__name__] = status.sent.get(type(message).__name__, 0) + 1
        status.counts, status.values = node.stats.counts, node.stats.values
        status.skipped, status.warnings = node.stats.skipped, node.stats.warnings
        screen.refresh()

    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C shows where it was
    try:
        run_inline(graph, observe)
    finally:
        screen.stop()


def _report_failure(outcome: Outcome) -> None:
    """The node's name and its traceback, last on the screen."""
    lines = [f"\n{outcome.failed} failed: {outcome.error}", f"log: {outcome.log}", outcome.traceback]
    print("\n".join(filter(None, lines)), file=sys.stderr, flush=True)
