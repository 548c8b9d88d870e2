"""What of a graph cannot run is refused before anything is written, or moved aside, in its output."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgs
from launch.graph import Graph, Slot
from launch.output import RESULTS, is_of_a_run, others_files
from launch.refusal import GraphError
from launch.run_directory import base_directory
from launch.settings_file import FILES
from launch.specs import check_addresses
from nodes.parameters import did_you_mean, located

MOST_THREADS = 1024  # of a node: more than any machine has cores
DEVICES = ("auto", "cpu", "cuda", "torch")  # torch: PyTorch on the CPU, in the place of C++


def check(graph: Graph) -> None:
    """Raises GraphError, which says what to do."""
    for slot in graph.slots.values():
        _check_placement(slot)
    for name, slot in graph.slots.items():  # what nodes that run here already know they lack
        if slot.placement.external:
            continue
        _check_device(name, slot.config.get("device"))
        try:
            slot.node.check(slot.parameters)
        except (OSError, ValueError) as error:
            raise GraphError(located(error, slot.node.Config, name)) from error
    if not graph.settings.inline:
        check_addresses(graph)
        base_directory(graph)
    try:
        _check_output(graph)
    except OSError as error:
        raise GraphError(f"output={graph.settings.output}: {error.strerror or error}") from error


def _check_placement(slot: Slot) -> None:
    for kind in slot.placement.best_effort:
        if kind not in msgs.TYPES:
            raise GraphError(
                f"{slot.name}.best_effort={kind}: no such message{did_you_mean(kind, msgs.TYPES)}; "
                f"there are: {', '.join(msgs.TYPES)}"
            )
    for threads in (slot.placement.threads, slot.config.get("threads")):
        if isinstance(threads, int) and not 1 <= threads <= MOST_THREADS:
            raise GraphError(
                f"{slot.name}.threads={threads}: must be 1 or more, at most {MOST_THREADS}, or null for a share of the "
                "cores"
            )
    cores = slot.placement.cpu
    if cores is None or slot.placement.external or not hasattr(os, "sched_getaffinity"):
        return
    there = os.sched_getaffinity(0)
    if not cores or not there.issuperset(cores):
        raise GraphError(
            f"{slot.name}.cpu={cores}: must be cores that this program may use, which are {_ranges(there)}; "
            "null: all of them"
        )


def _check_output(graph: Graph) -> None:
    """What is not of a run stays as it is, and what is read stays where it is. Raises OSError for no folder's name."""
    output = Path(graph.settings.output)
    for name in graph.sources:
        for key in FILES:
            value = graph.slots[name].config.get(key)
            if isinstance(value, str) and value and _in_results(_real(value), _real(output)):
                raise GraphError(f"output={output}: has {name}.{key}={value} in it; give another output=DIR")
    if others := others_files(output):
        raise GraphError(
            f"output={output}: has {', '.join(others)}, which no run has left there and this one would replace; give "
            "another output=DIR"
        )


def _real(path: str | Path) -> Path:
    """Without links; of one that leads to itself, as it is (`Path.resolve` raises RuntimeError for that)."""
    return Path(os.path.realpath(path))


def _in_results(read: Path, output: Path) -> bool:
    """Whether what is read lies where results do. A run that is gone on with reads its own output's checkpoint."""
    if read == output:
        return not is_of_a_run(output)
    return any(read.is_relative_to(output / name) for name in RESULTS)


def _ranges(numbers: set[int]) -> str:
    """As in 0-3, 8."""
    first = [number for number in sorted(numbers) if number - 1 not in numbers]
    last = [number for number in sorted(numbers) if number + 1 not in numbers]
    return ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in zip(first, last, strict=True))


def _check_device(slot: str, device: Any) -> None:
    """A GPU that a slot asks for by itself, not by the global `device`, must be there."""
    if not isinstance(device, str):
        return
    if device.partition(":")[0] not in DEVICES:
        raise GraphError(f"{slot}.device={device}: must be auto, cpu, cuda or cuda:<number>")
    if not device.startswith("cuda"):
        return
    import torch  # takes a second to load

    from mvsgs_core.devices import torch_refuses

    there, number = torch.cuda.device_count(), device.partition(":")[2] or "0"
    if not number.isdigit() or int(number) >= there:
        raise GraphError(f"{slot}.device={device}: this machine has {there} CUDA devices; use {slot}.device=cpu")
    if refused := torch_refuses(device):
        raise GraphError(f"{slot}.device={device}: {refused}; or use {slot}.device=cpu")
