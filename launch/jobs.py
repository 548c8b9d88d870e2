"""One run from its composed configuration: graph, processes or one process, summary, exit code."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import nodes
from launch.checks import check
from launch.compose import graph_of
from launch.graph import Graph
from launch.inline import run_inline
from launch.outcome import FAILED, REFUSED, Outcome, finished
from launch.output import Output, new_folder
from launch.printing import say
from launch.refusal import GraphError
from launch.screen import Screen, make_screen
from launch.settings_file import lasting
from launch.status import NodeStatus
from launch.summary import summary
from launch.supervise import Supervisor


class RunFailed(RuntimeError):
    """A job of a sweep failed: the sweep goes on, and ends with a non-zero exit code."""


@dataclass(frozen=True)
class Job:
    """What Hydra hands over."""

    config: DictConfig
    overrides: Sequence[str]
    choices: dict[str, Any]
    number: int | None  # in a sweep
    resumed: bool = False  # goes on with what is in its output directory

    @property
    def command(self) -> str:
        """What a user types for the same."""
        words = [text.lstrip("+") for text in self.overrides]
        resume = [f"resume={self.config.output}"] if self.resumed else []
        return shlex.join(["mvsgs", *resume, *words])

    @staticmethod
    def of(config: DictConfig, hydra: Any) -> Job:
        sweep = hydra.mode == RunMode.MULTIRUN
        if sweep:
            OmegaConf.update(config, "output", hydra.runtime.output_dir, force_add=True)
        return Job(config, list(hydra.overrides.task), dict(hydra.runtime.choices), hydra.job.num if sweep else None)


def run(job: Job) -> int:
    """Runs one job and returns its exit code. In a sweep a failure is raised instead: RunFailed, after which the sweep
    goes on, or SystemExit where the user stopped it."""
    if job.number is not None:
        say(f"job {job.number}: {' '.join(text.lstrip('+') for text in job.overrides)}")
    code = _run(job)
    if job.number is not None and code:
        if code > 128:
            raise SystemExit(code)
        raise RunFailed(f"job {job.number} ended with code {code}")
    return code


def _run(job: Job) -> int:
    try:
        graph = graph_of(job.config, job.overrides, job.choices)
        check(graph)
        graph = _in_its_folder(graph, job)
        in_order = all(slot.node.in_stream_order for slot in graph.slots.values())
        output = Output(Path(graph.settings.output), resumable=in_order)
    except GraphError as error:
        return refused(error)
    try:
        if moved := output.begin(lasting(graph), job.command, resumed=job.resumed):
            say(f"note: {moved}")
        screen = make_screen(graph.settings.screen)
        said: list[Outcome] = []

        def over(outcome: Outcome) -> None:
            problem = output.settle(outcome, scored=_scored(graph), keep=_kept(graph))
            if outcome not in said:
                if problem:
                    screen.note(problem)
                _say(outcome, screen, output)
            said.append(outcome)

        outcome = _run_inline(graph, screen) if graph.settings.inline else Supervisor(graph, screen, over).run()
        over(outcome)
        return outcome.code
    except GraphError as error:
        output.settle(Outcome(REFUSED, f"refused: {error}"))
        return refused(error)
    except BaseException as error:
        output.settle(Outcome(FAILED, f"{type(error).__name__}: {error}"))
        raise
    finally:
        output.release()


def _in_its_folder(graph: Graph, job: Job) -> Graph:
    """The graph of a run whose output nobody named, in a folder that is made for it alone."""
    if job.config.get("output"):
        return graph
    folder = str(new_folder(Path(graph.settings.output)))
    if folder == graph.settings.output:
        return graph
    OmegaConf.update(job.config, "output", folder, force_add=True)
    return graph_of(job.config, job.overrides, job.choices)


def refused(error: GraphError) -> int:
    """Says why nothing runs, in one line; the exit code."""
    say(f"error: {' '.join(line.strip() for line in str(error).splitlines())}", sys.stderr)
    return REFUSED


def _scored(graph: Graph) -> bool:
    """Whether some node writes the report of a finished run."""
    return any(slot.node.reports for slot in graph.slots.values())


def _kept(graph: Graph) -> bool:
    """Whether the checkpoint is to stay after a complete run."""
    return any(slot.config.get("keep_map") for slot in graph.slots.values())


def _run_inline(graph: Graph, screen: Screen) -> Outcome:
    statuses = {name: NodeStatus(name, "running") for name in graph.slots}
    screen.start(graph, statuses, {})

    def observe(slot: str, node: nodes.Node, message: Any) -> None:
        status = statuses[slot]
        status.sent[type(message).__name__] = status.sent.get(type(message).__name__, 0) + 1
        status.counts, status.values = node.stats.counts, node.stats.values
        status.skipped, status.warnings = node.stats.skipped, list(node.stats.warnings)
        screen.refresh()

    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C shows where it was
    try:
        ran = run_inline(graph, observe)
    finally:
        screen.stop()
    nothing = {name: str(node.stats.values["nothing"]) for name, node in ran.items() if "nothing" in node.stats.values}
    return finished((), nothing)


def _say(outcome: Outcome, screen: Screen, output: Output) -> None:
    """What a run reached, what failed, and what can be done about it: last on the screen."""
    for failure in (*outcome.observers, *([outcome.failed] if outcome.failed else [])):
        lines = [f"\n{failure.node} failed: {failure.error}", f"log: {failure.log}", failure.traceback]
        say("\n".join(filter(None, lines)), sys.stderr)
    if outcome.whole:
        screen.note(summary(output.path))
    else:
        if outcome.failed is None:
            screen.note(outcome.reason)
        screen.note(elsewhere(outcome.unseen, output) if outcome.unseen else unfinished(output))
    for node, reason in outcome.nothing.items():
        screen.note(f"nothing to show: {node}: {reason}")
    if not outcome.whole:
        return
    for failure in outcome.observers:
        screen.note(f"the map is finished, but {failure.node} failed: {failure.error}")
    if output.resume:
        screen.note(f"its report is still to be made: {output.resume}")


def elsewhere(stages: Sequence[str], output: Output) -> str:
    """Where the results of stages are that may still work: who goes on with the run beside one does its work twice."""
    there = "still works, or has ended, where it was started: what it makes is there"
    lines = ["", *(f"{name} {there}" for name in stages)]
    if output.resume:
        lines.append(f"if it did not end well: {output.resume}")
    return "\n".join(lines)


def unfinished(output: Output) -> str:
    """Where the map so far is, and how to go on."""
    there = [name for name in ("map.ply", "trajectory.txt") if (output.path / name).exists()]
    lines = [f"\nunfinished: the map so far is {output.path / 'map.ply'}" if "map.ply" in there else "\nno map there"]
    lines.append(
        f"go on with it: {output.resume}" if output.resume else f"nothing to go on with in {output.path}: run it again"
    )
    return "\n".join(lines)
